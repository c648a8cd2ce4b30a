"""What several parts of calibration share."""
