"""Estimators: samples in, estimates out. No device, no thread, no clock, no file."""
