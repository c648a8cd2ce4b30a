"""Data types of the continuous-time estimate: observations, curves, camera paths, clocks."""
