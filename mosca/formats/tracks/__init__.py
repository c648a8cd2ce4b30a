"""Tracks in files: CSV, C3D, TRC."""
