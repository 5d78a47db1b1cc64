"""Routines: move devices, feed estimators, write results."""
