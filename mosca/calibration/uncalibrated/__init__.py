"""Calibration of cameras without initial values: from a wand of known length, or from one light."""
