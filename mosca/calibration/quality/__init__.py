"""Quality of a calibration: checks, limits, findings, accuracy in the volume."""
