"""Files of modes of vibration."""
