"""What is wrong with a take: evidence from frames, stamps, tracks and rig file, and the cause that fits it best."""
