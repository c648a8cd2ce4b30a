"""Tracks and bodies against the truth, or against what is certified."""
