"""Scenario tables to scenes, cameras and rigs."""
