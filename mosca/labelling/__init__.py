"""Names for tracks: marker models, marker-set templates, coded targets, blinking LEDs."""
