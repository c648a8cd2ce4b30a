"""Frames in, trajectories out: the pipeline that runs unchanged on rendered and on real frames.

Conventions, said once and kept in every room:

- SI units inside: m, s, rad; px for image quantities. Any other unit is part of the name
  (``K1_per_mm2``, ``_px``, ``_ns``, ``_mm``). The world is right-handed with Z up.
- Camera frame: x right, y down, z forward. Pixel (0, 0) is the *centre* of the top-left pixel.
  Points are (x, y), image arrays are (H, W).
- Poses are named so that neighbours cancel: ``world_from_camera``, ``camera_from_marker``.
  Quaternions are wxyz.
- Time is integer nanoseconds in data and float seconds from the session's start in the maths.
  A Frame carries the raw stamp and the event that it marks; mid-exposure is computed once,
  in ``mosca.data.frames``.
- Data is frozen and really read-only; a change is a new value.
- One seed a run, split into named streams; no global random state.
"""

__version__ = "0.1.0"
