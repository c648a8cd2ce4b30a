"""Calibration: from observed points of known geometry to interior and exterior orientation."""
