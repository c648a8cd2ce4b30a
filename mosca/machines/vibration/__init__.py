"""Vibration from tracks: displacements, spectra, noise floor, and modes without a known excitation."""
