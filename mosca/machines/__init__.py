"""Measurements of machines: models of robots, vibration, flights on poses, cameras that orient themselves."""
