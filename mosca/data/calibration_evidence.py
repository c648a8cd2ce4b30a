"""Data of a calibration report besides the calibration itself."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, read_only


@dataclass(frozen=True, eq=False)
class AccuracyGrid:
    """Predicted standard deviation of a measured point on a grid.

    ``x``, ``y``, ``z``: axes [m, world]; ``detection_m`` and ``calibration_m`` (nx, ny, nz) standard deviations in
    space [m] from either, NaN where too few cameras see it; ``detection_sigma_px`` that of an image coordinate.
    """

    x: Array
    y: Array
    z: Array
    detection_m: Array
    calibration_m: Array
    detection_sigma_px: float

    def __post_init__(self) -> None:
        for name in ("x", "y", "z"):
            object.__setattr__(self, name, read_only(getattr(self, name), (None,), name))
        shape = (len(self.x), len(self.y), len(self.z))
        for name in ("detection_m", "calibration_m"):
            object.__setattr__(self, name, read_only(getattr(self, name), shape, name))

    @property
    def sigma_m(self) -> Array:
        """Standard deviation (nx, ny, nz) of both together [m]."""
        return np.asarray(np.hypot(self.detection_m, self.calibration_m))


@dataclass(frozen=True, eq=False)
class HeldOutLengths:
    """Lengths that the calibration did not use: ``length_m`` (k,) measured, ``sigma_m`` (k,), what is ``true_m``.

    ``scale_error`` +- ``scale_sigma``: mean of measured over true, less 1.
    """

    length_m: Array
    sigma_m: Array
    true_m: float
    scale_error: float
    scale_sigma: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "length_m", read_only(self.length_m, (None,), "length_m"))
        object.__setattr__(self, "sigma_m", read_only(self.sigma_m, (len(self.length_m),), "sigma_m"))


@dataclass(frozen=True, eq=False)
class CalibrationEvidence:
    """Evidence for a calibration of c cameras.

    ``covered`` (c, rows, columns) bool: cells of each image that the target's points cover; ``links`` (c, c) number
    of points that connect each pair of cameras; ``groups`` (c,) connected component of each camera; ``missing`` (k,
    2) cameras between which a link would connect two groups; ``accuracy``, ``lengths``: None where not computed;
    ``comparison``: lines of text of a comparison with another rig; ``made_from``: session and command, in a line.
    """

    covered: Array
    links: Array
    groups: Array
    missing: Array
    accuracy: AccuracyGrid | None = None
    lengths: HeldOutLengths | None = None
    comparison: tuple[str, ...] = ()
    made_from: str = ""

    def __post_init__(self) -> None:
        count = len(np.asarray(self.covered))
        object.__setattr__(self, "covered", read_only(self.covered, (count, None, None), "covered", np.bool_))
        object.__setattr__(self, "links", read_only(self.links, (count, count), "links", np.int64))
        object.__setattr__(self, "groups", read_only(self.groups, (count,), "groups", np.int64))
        object.__setattr__(self, "missing", read_only(self.missing, (None, 2), "missing", np.int64))
        object.__setattr__(self, "comparison", tuple(self.comparison))
