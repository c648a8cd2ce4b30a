"""Tracks of neighbouring capture volumes joined into one set."""
