"""Names for tracks: marker models, coded targets, blinking LEDs."""
