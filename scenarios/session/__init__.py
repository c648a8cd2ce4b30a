"""The calibration session of a scenario: its scenes, its faults, and the rig estimated from it."""
