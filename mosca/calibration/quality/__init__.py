"""Whether a calibration can be believed: checks, limits, findings, accuracy in the volume."""
