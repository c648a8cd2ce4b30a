"""Vibration of things that tracks show: displacements, spectra, noise floor, and modes without a known excitation."""
