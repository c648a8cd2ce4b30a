"""Data of a calibration report besides the calibration itself."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class AccuracyGrid:
    """Predicted standard deviation of a measured point on a grid.

    ``x``, ``y``, ``z``: axes [m, world]; ``detection_m`` and ``calibration_m`` (nx, ny, nz): standard deviations in
    space [m] from detection and from calibration, NaN where too few cameras see the point; ``detection_sigma_px``:
    standard deviation of an image coordinate.
    """

    x: Array
    y: Array
    z: Array
    detection_m: Array
    calibration_m: Array
    detection_sigma_px: float

    def __post_init__(self) -> None:
        set_read_only(self, x=(None,), y=(None,), z=(None,))
        shape = (len(self.x), len(self.y), len(self.z))
        set_read_only(self, detection_m=shape, calibration_m=shape)

    @property
    def sigma_m(self) -> Array:
        """Standard deviation (nx, ny, nz) from both together [m]."""
        return np.asarray(np.hypot(self.detection_m, self.calibration_m))


@dataclass(frozen=True, eq=False)
class HeldOutLengths:
    """Measurements ``length_m`` (k,) with ``sigma_m`` (k,) of a length ``true_m`` that the calibration did not use.

    ``scale_error`` +- ``scale_sigma``: mean ratio of measured to true length, less 1.
    """

    length_m: Array
    sigma_m: Array
    true_m: float
    scale_error: float
    scale_sigma: float

    def __post_init__(self) -> None:
        set_read_only(self, length_m=(None,))
        set_read_only(self, sigma_m=(len(self.length_m),))


@dataclass(frozen=True, eq=False)
class CalibrationEvidence:
    """Evidence for a calibration of c cameras.

    ``covered`` (c, rows, columns) bool: cells of each image that the target's points cover; ``links`` (c, c) number
    of points that connect each pair of cameras; ``groups`` (c,) connected component of each camera; ``missing`` (k,
    2) cameras between which a link would connect two groups; ``accuracy``, ``lengths``: None where not computed;
    ``made_from``: session and command, in a line.
    """

    covered: Array
    links: Array
    groups: Array
    missing: Array
    accuracy: AccuracyGrid | None = None
    lengths: HeldOutLengths | None = None
    made_from: str = ""

    def __post_init__(self) -> None:
        count = len(np.asarray(self.covered))
        set_read_only(self, np.bool_, covered=(count, None, None))
        set_read_only(self, np.int64, links=(count, count), groups=(count,), missing=(None, 2))
