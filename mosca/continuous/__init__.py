"""Trajectories as functions of time, from cameras that are not synchronised and may be worn on the body.

The walk: Frames (not frame sets) -> image points, each of its own instant (``observations``) -> curves of points and
of cameras, clocks of the cameras, all estimated at once -> covariance at any instant. The second paper's own models,
which interpolate to common times first, are in ``comparison_methods``.
"""
