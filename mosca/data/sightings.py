"""Image points of a calibration session, with mark, exposure and camera."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from mosca.data.arrays import Array, read_only, set_read_only


@dataclass(frozen=True, eq=False)
class Sightings:
    """n image points of a target's marks in the exposures of a calibration session.

    ``cameras``: their names; ``sizes`` (c, 2): width and height of their images [px]; ``frames``: the number of frame
    sets. Each image point has ``camera`` (n,) and ``frame`` (n,), indices; ``mark`` (n,), the row of its mark in the
    target's list of positions, -1 where unknown; ``xy_px`` (n, 2); ``covariance_px2`` (n, 2, 2) of its random error;
    ``diameter_px`` (n,) of the mark's image, longer axis, NaN where it has none; ``ellipticity`` (n, 2) of the mark's
    image and ``ellipticity_sigma`` (n,) as in ``Detections``, zero where they are not known (the default for all).
    """

    cameras: tuple[str, ...]
    sizes: Array
    frames: int
    camera: Array
    frame: Array
    mark: Array
    xy_px: Array
    covariance_px2: Array
    diameter_px: Array
    ellipticity: Array = field(default_factory=lambda: np.zeros((0, 2)))
    ellipticity_sigma: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        n, c = len(self.xy_px), len(self.cameras)
        set_read_only(self, np.int64, sizes=(c, 2), camera=(n,), frame=(n,), mark=(n,))
        set_read_only(self, xy_px=(n, 2), covariance_px2=(n, 2, 2), diameter_px=(n,))
        ellipticity = self.ellipticity if len(self.ellipticity) else np.zeros((n, 2))
        object.__setattr__(self, "ellipticity", read_only(ellipticity, (n, 2), "ellipticity"))
        sigma = self.ellipticity_sigma if len(self.ellipticity_sigma) else np.zeros(n)
        object.__setattr__(self, "ellipticity_sigma", read_only(sigma, (n,), "ellipticity_sigma"))
        for name, index, end in (("camera", self.camera, c), ("frame", self.frame, self.frames)):
            if len(index) and (index.min() < 0 or index.max() >= end):
                raise ValueError(f"{name}: {index.min()} to {index.max()} given, 0 to {end - 1} allowed")

    def __len__(self) -> int:
        return len(self.xy_px)

    @property
    def sigma_px(self) -> Array:
        """Standard deviation (n,) of a coordinate, rms of both axes [px]."""
        return np.asarray(np.sqrt(np.trace(self.covariance_px2, axis1=1, axis2=2) / 2))

    def only(self, keep: Array) -> "Sightings":
        """Return the image points ``keep`` (mask or indices); the numbering of cameras and frames is unchanged."""
        points = [one.name for one in fields(self) if one.name not in ("cameras", "sizes", "frames")]
        return replace(self, **{name: getattr(self, name)[keep] for name in points})

    def without(self, cameras: Collection[str]) -> "Sightings":
        """Return the image points of all cameras but these; the remaining cameras are renumbered."""
        kept = np.array([name not in cameras for name in self.cameras])
        left = self.only(kept[self.camera])
        names = tuple(name for name in self.cameras if name not in cameras)
        return replace(left, cameras=names, sizes=self.sizes[kept], camera=(np.cumsum(kept) - 1)[left.camera])

    @classmethod
    def joined(cls, cameras: tuple[str, ...], sizes: Array, frames: int, parts: Sequence["Part"]) -> "Sightings":
        """Return the image points of ``parts``, each of one image."""

        def stacked(name: str, shape: tuple[int, ...]) -> Array:
            rows = [np.asarray(getattr(part, name), dtype=float).reshape(-1, *shape) for part in parts]
            return np.concatenate(rows) if rows else np.empty((0, *shape))

        counts = [len(part.mark) for part in parts]
        return cls(
            cameras,
            sizes,
            frames,
            np.repeat([part.camera for part in parts], counts),
            np.repeat([part.frame for part in parts], counts),
            stacked("mark", ()).astype(np.int64),
            stacked("xy_px", (2,)),
            stacked("covariance_px2", (2, 2)),
            stacked("diameter_px", ()),
            stacked("ellipticity", (2,)),
            stacked("ellipticity_sigma", ()),
        )


@dataclass(frozen=True, eq=False)
class Part:
    """Image points of one image: ``camera`` and ``frame`` are indices, the arrays as in ``Sightings``."""

    camera: int
    frame: int
    mark: Array
    xy_px: Array
    covariance_px2: Array
    diameter_px: Array
    ellipticity: Array = field(default_factory=lambda: np.zeros((0, 2)))
    ellipticity_sigma: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not len(self.ellipticity):
            object.__setattr__(self, "ellipticity", np.zeros((len(self.mark), 2)))
            object.__setattr__(self, "ellipticity_sigma", np.zeros(len(self.mark)))
