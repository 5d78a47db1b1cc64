"""Reports: the page and the terminal summary of a calibration."""
