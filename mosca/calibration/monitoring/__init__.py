"""A rig under observation while it runs: bumps, drift, re-orientation."""
