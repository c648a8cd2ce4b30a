"""Scenes, cameras and rigs from scenario tables."""
