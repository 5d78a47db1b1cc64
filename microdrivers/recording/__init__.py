"""Recorded data as a source of samples."""
