"""Trajectories as functions of time, from cameras that are not synchronised and may be worn on the body.

Steps: frames (not frame sets) -> image points, each with its own instant (``observations``) -> curves of points and
of cameras and the cameras' clocks, all estimated jointly -> covariance at any instant. The second paper's own models,
which interpolate to common times first, are in ``comparison_methods``.
"""
