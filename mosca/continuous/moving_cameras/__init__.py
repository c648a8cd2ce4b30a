"""Cameras that move: a rig at an instant, body-worn cameras, mutual observation."""
