"""What goes into and comes out of continuous time: observations, curves, camera paths, clocks."""
