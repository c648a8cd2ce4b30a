"""Poses of a moving camera from a test field in its images, and their comparison with those of a rig."""
