"""Calibration of one camera: adjustment, choice of parameters, outliers."""
