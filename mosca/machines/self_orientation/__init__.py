"""Where a moving camera was: its poses from a test field in its images, and how they compare with a rig's."""
