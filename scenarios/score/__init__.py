"""Scores of tracks and bodies against the truth, or against certified values."""
