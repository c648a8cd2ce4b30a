"""Faults of a take: evidence from frames, stamps, tracks and rig file, and the cause that fits the evidence best."""
