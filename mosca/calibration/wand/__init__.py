"""Wand calibration of cameras without initial values."""
