"""Detections: where a frame shows targets, with the error that each place has."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, read_only


@dataclass(frozen=True, eq=False)
class Detections:
    """Targets found in one image.

    ``xy_px`` (n, 2) sub-pixel centroids; ``covariance_px2`` (n, 2, 2) of their random error;
    ``diameter_px`` (n,) equivalent diameter of the region; ``peak`` (n,) largest grey value [DN];
    ``elongation`` (n,) longer over shorter side of the region's box (1 for a disc).
    """

    camera: str
    xy_px: Array
    covariance_px2: Array
    diameter_px: Array
    peak: Array
    elongation: Array

    def __post_init__(self) -> None:
        n = len(np.asarray(self.xy_px))
        for name, shape in (
            ("xy_px", (None, 2)),
            ("covariance_px2", (n, 2, 2)),
            ("diameter_px", (n,)),
            ("peak", (n,)),
            ("elongation", (n,)),
        ):
            object.__setattr__(self, name, read_only(getattr(self, name), shape, name))

    def __len__(self) -> int:
        return len(self.xy_px)

    @classmethod
    def none(cls, camera: str) -> "Detections":
        """No targets: an image without any, or no image."""
        return cls(camera, np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0), np.empty(0), np.empty(0))
