"""The ground floor: samples, bus, clock, errors, units. Imports nothing else of microdrivers."""
