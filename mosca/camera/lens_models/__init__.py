"""Lens models of the pipeline, one file a model.

Each file has the same two functions, both for many points at once:

- ``directions(lens, xy_px)``: pixel (n, 2) -> direction (n, 3) in the camera frame.
- ``pixels(lens, directions)``: direction (n, 3) -> pixel (n, 2) with its Jacobians with respect to the
  direction (n, 2, 3) and to the lens parameters (n, 2, p), p in the order of the dataclass's fields.
  NaN where the lens does not image the direction.

A new lens is a dataclass in ``mosca.data.rig``, a file here and a line in ``mosca.camera.projection``.
"""
