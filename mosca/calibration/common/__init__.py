"""Functions shared by several parts of calibration."""
