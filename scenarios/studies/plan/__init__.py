"""From a plan file to a planned rig, its scenario, and its verification."""
