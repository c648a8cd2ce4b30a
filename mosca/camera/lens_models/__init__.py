"""Lens models of the pipeline, one file each: every mapping exists once, compiled, for one point at a time.

Each file has three functions of a lens row (``row``):

- ``direction``: pixel -> unit direction in the camera frame, and the pixel's derivative by the direction.
- ``image``: direction -> pixel, and its derivatives by the direction and by the lens parameters; ``fast_image``: the
  same with arithmetic that may be reordered.
- ``radial_slope``: slope of the radial mapping, whose first zero is the fold (``monotonic_range``).

``arrays`` applies them to many points. A new lens is a dataclass in ``mosca.data.rig``, a file here and a line
in each function of ``arrays`` that chooses by model.
"""
