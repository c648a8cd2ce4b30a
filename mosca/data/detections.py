"""Detections: image positions of targets in a frame, with covariance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mosca.data.arrays import Array, read_only, set_read_only
from mosca.data.frames import FrameSet

SATURATED, MERGED, PARTIAL, UNREFINED = 1, 2, 4, 8
"""Bits of ``Detections.flags``: some pixels are saturated; two merged targets; a partly occluded target; a position
without sub-pixel refinement (and with the covariance of such a position)."""


@dataclass(frozen=True, eq=False)
class Detections:
    """Targets found in one image."""

    camera: str
    xy_px: Array
    """(n, 2) sub-pixel centroids."""
    covariance_px2: Array
    """(n, 2, 2) covariance of their random error."""
    diameter_px: Array
    """(n,) diameter of the target's image; where it was fitted, without the blur of lens and pixel."""
    peak: Array
    """(n,) largest grey value [DN]."""
    elongation: Array
    """(n,) longer over shorter side of the region's box (1 for a disc)."""
    flags: Array = field(default_factory=lambda: np.empty(0, np.uint8))
    """(n,) uint8, bits as above, 0 where nothing is odd (the default for all)."""
    diameter_sigma_px: Array = field(default_factory=lambda: np.empty(0))
    """(n,) standard deviation of the diameter; 0: not known (the default for all)."""
    ellipticity: Array = field(default_factory=lambda: np.empty(0))
    """(n, 2) ellipticity of the target's image, ``ln(a / b) (cos 2t, sin 2t)``: semi-axes a >= b, a at the angle t
    from x to y (conformal shear, Bernstein and Jarvis 2002); zero for a circle."""
    ellipticity_sigma: Array = field(default_factory=lambda: np.empty(0))
    """(n,) standard deviation of the noise of each component; 0: not known (the default for all)."""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.xy_px))
        set_read_only(self, xy_px=(None, 2), covariance_px2=(n, 2, 2), diameter_px=(n,), peak=(n,), elongation=(n,))
        flags = self.flags if len(self.flags) else np.zeros(n, np.uint8)
        object.__setattr__(self, "flags", read_only(flags, (n,), "flags", np.uint8))
        sigma = self.diameter_sigma_px if len(self.diameter_sigma_px) else np.zeros(n)
        object.__setattr__(self, "diameter_sigma_px", read_only(sigma, (n,), "diameter_sigma_px"))
        ellipticity = self.ellipticity if len(self.ellipticity) else np.zeros((n, 2))
        object.__setattr__(self, "ellipticity", read_only(ellipticity, (n, 2), "ellipticity"))
        sigma = self.ellipticity_sigma if len(self.ellipticity_sigma) else np.zeros(n)
        object.__setattr__(self, "ellipticity_sigma", read_only(sigma, (n,), "ellipticity_sigma"))

    def __len__(self) -> int:
        return len(self.xy_px)

    @classmethod
    def handed_over(cls, camera: str, columns: Sequence[Array]) -> "Detections":
        """Return detections of valid read-only columns in the order of the fields, without checks or copies."""
        new = object.__new__(cls)
        new.__dict__.update(zip(cls.__dataclass_fields__, (camera, *columns), strict=True))
        return new

    @classmethod
    def none(cls, camera: str) -> "Detections":
        """Return no detections: for an image without targets, or without an image."""
        return cls(camera, np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0), np.empty(0), np.empty(0))


Seen = tuple[FrameSet, Mapping[str, Detections], float]
"""A frame set, its cameras' detections, and the computing time that these took [s]."""
