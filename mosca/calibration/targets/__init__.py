"""Calibration targets in images: boards, test fields, intervals without motion."""
