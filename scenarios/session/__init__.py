"""The calibration session of a scenario: what it shows, what goes wrong in it, and the rig that it gives."""
