"""Rigid bodies, marker models and poses in files."""
