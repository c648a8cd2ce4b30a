"""Input of a bundle adjustment: cameras, object points, poses of moving things, observations, lengths, datum."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from mosca.data.arrays import Array, read_only
from mosca.data.rig import Camera, Pose
from mosca.errors import InputError

FOCAL = "f_px"
"""Free lens parameter that moves fx and fy together and keeps their ratio (OpenCV's and the fisheye model)."""


@dataclass(frozen=True, eq=False)
class CameraUnknowns:
    """A camera, or a camera at one time: starting values and unknowns.

    Raises InputError for a lens parameter that cannot be free.
    """

    camera: Camera
    free: tuple[str, ...] = ()
    """Lens parameters to estimate, or "f_px" (fx and fy together)."""
    held: bool = False
    """Whether the pose stays as it is."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "free", tuple(self.free))
        where, lens = f"camera '{self.camera.name}'", self.camera.lens
        names = [one.name for one in fields(lens)]
        allowed = names + ([FOCAL] if "fx_px" in names else [])
        for name in self.free:
            if name not in allowed or self.free.count(name) > 1:
                raise InputError(
                    f"{where}: lens parameter '{name}' cannot be free here; allowed, each once: {', '.join(allowed)}"
                )
        if FOCAL in self.free and {"fx_px", "fy_px"} & set(self.free):
            raise InputError(f"{where}: '{FOCAL}' moves fx_px and fy_px together; leave these out, or '{FOCAL}'")
        if {"c_mm", "mx_mm_per_px", "my_mm_per_px"} <= set(self.free):
            raise InputError(
                f"{where}: c_mm, mx_mm_per_px and my_mm_per_px have two degrees of freedom; hold mx_mm_per_px"
            )


@dataclass(frozen=True, eq=False)
class ObjectPoints:
    """Object points ``xyz`` (p, 3) [m] with a-priori information; made by ``free``, ``fixed``, ``weighted``.

    A free point with NaN coordinates gets its starting values by intersection of its rays. ``held`` (p,) bool;
    ``information`` (p, 3, 3) [1/m^2] inverse covariance of the given coordinates, zero where free, None where
    no point is weighted. The coordinates of a point that is seen on a placed thing are in the thing's frame.
    """

    xyz: Array
    held: Array
    information: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.xyz)
        object.__setattr__(self, "xyz", read_only(self.xyz, (n, 3), "xyz"))
        object.__setattr__(self, "held", read_only(self.held, (n,), "held", np.bool_))
        if self.information is not None:
            object.__setattr__(self, "information", read_only(self.information, (n, 3, 3), "information"))
        given = self.held if self.information is None else self.held | (self.information != 0).any(axis=(1, 2))
        if not np.isfinite(self.xyz[given]).all():
            raise ValueError("xyz: a fixed or weighted point needs finite coordinates")

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def free(cls, xyz: Array | int) -> "ObjectPoints":
        """Return free points with starting values (p, 3) [m], or that many without."""
        start = np.full((xyz, 3), np.nan) if isinstance(xyz, int) else np.asarray(xyz, dtype=float)
        return cls(start, np.zeros(len(start), dtype=bool))

    @classmethod
    def fixed(cls, xyz: Array) -> "ObjectPoints":
        """Return points held at (p, 3) [m]: control points without error."""
        return cls(np.asarray(xyz, dtype=float), np.ones(len(xyz), dtype=bool))

    @classmethod
    def weighted(cls, xyz: Array, sigma_m: Array | float) -> "ObjectPoints":
        """Return points known to be at (p, 3) [m] with standard deviations or covariances.

        ``sigma_m``: a number, (p,) or (p, 3) [m], or covariances (p, 3, 3) [m^2].
        """
        sigma = np.asarray(sigma_m, dtype=float)
        if sigma.ndim == 3:
            information = np.linalg.inv(sigma)
        else:
            each = np.broadcast_to(sigma[:, None] if sigma.ndim == 1 else sigma, (len(xyz), 3))
            if not (each > 0).all():
                raise ValueError("sigma_m: standard deviations above 0 are wanted")
            information = np.eye(3) / each[:, :, None] ** 2
        return cls(np.asarray(xyz, dtype=float), np.zeros(len(xyz), dtype=bool), information)

    def __add__(self, other: "ObjectPoints") -> "ObjectPoints":
        """Return these points followed by ``other``."""
        both = [np.zeros((len(one), 3, 3)) if one.information is None else one.information for one in (self, other)]
        none = self.information is None and other.information is None
        return ObjectPoints(
            np.concatenate([self.xyz, other.xyz]),
            np.concatenate([self.held, other.held]),
            None if none else np.concatenate(both),
        )


@dataclass(frozen=True, eq=False)
class Placements:
    """Poses ``world_from_thing`` of rigid things (a board, a wand, a body), one per thing and frame: unknown.

    ``rotation`` (f, 3, 3), ``translation`` (f, 3) [m]: starting values. A moving camera is modelled with the roles
    exchanged: the camera fixed at the origin, the scene moving.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        n = len(self.translation)
        object.__setattr__(self, "rotation", read_only(self.rotation, (n, 3, 3), "rotation"))
        object.__setattr__(self, "translation", read_only(self.translation, (n, 3), "translation"))

    def __len__(self) -> int:
        return len(self.translation)

    @classmethod
    def of(cls, poses: Sequence[Pose]) -> "Placements":
        """Return placements with starting values ``poses``."""
        rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
        return cls(rotations, np.array([pose.translation for pose in poses]).reshape(-1, 3))

    def pose(self, index: int) -> Pose:
        """Return one pose."""
        return Pose(self.rotation[index], self.translation[index])


NO_PLACEMENTS = Placements(np.zeros((0, 3, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Observations:
    """n image points."""

    camera: Array
    """(n,) index into the problem's cameras."""
    point: Array
    """(n,) index into the problem's object points."""
    xy_px: Array
    """(n, 2) measured."""
    placement: Array | None = None
    """(n,) index of the pose of the point's rigid thing, -1 (default) for a point of the world."""
    sigma_px: Array | float = 1.0
    """(n,) or a number: a-priori standard deviation of a coordinate."""

    def __post_init__(self) -> None:
        n = len(self.xy_px)
        object.__setattr__(self, "camera", read_only(self.camera, (n,), "camera", np.int64))
        object.__setattr__(self, "point", read_only(self.point, (n,), "point", np.int64))
        object.__setattr__(self, "xy_px", read_only(self.xy_px, (n, 2), "xy_px"))
        placement = np.full(n, -1) if self.placement is None else self.placement
        object.__setattr__(self, "placement", read_only(placement, (n,), "placement", np.int64))
        sigma = np.broadcast_to(np.asarray(self.sigma_px, dtype=float), (n,))
        object.__setattr__(self, "sigma_px", read_only(sigma, (n,), "sigma_px"))
        if not np.isfinite(self.xy_px).all() or not (sigma > 0).all() or not np.isfinite(sigma).all():
            raise ValueError("xy_px and sigma_px: finite numbers, sigma_px above 0, are wanted; leave others out")

    def __len__(self) -> int:
        return len(self.xy_px)


@dataclass(frozen=True, eq=False)
class Distances:
    """Known distances ``length_m`` (d,) +- ``sigma_m`` (d,) between points ``first`` and ``second`` (d,)."""

    first: Array
    second: Array
    length_m: Array
    sigma_m: Array

    def __post_init__(self) -> None:
        n = len(self.first)
        for name, dtype in (("first", np.int64), ("second", np.int64), ("length_m", float), ("sigma_m", float)):
            object.__setattr__(self, name, read_only(getattr(self, name), (n,), name, dtype))
        if not (self.length_m > 0).all() or not (self.sigma_m > 0).all() or (self.first == self.second).any():
            raise ValueError("distances: above 0, with sigma_m above 0, between two different points are wanted")

    def __len__(self) -> int:
        return len(self.first)


NO_DISTANCES = Distances(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Problem:
    """A bundle adjustment: its unknowns with starting values, its observations and its datum.

    ``datum``: "given": held or weighted unknowns fix the coordinate system; "points": a free network, in which the
    seen points of the world neither shift, rotate nor, where no length is known, stretch against their given values
    (inner constraints, Meissl 1962).
    """

    cameras: tuple[CameraUnknowns, ...]
    observations: Observations
    points: ObjectPoints
    placements: Placements = NO_PLACEMENTS
    distances: Distances = NO_DISTANCES
    datum: Literal["given", "points"] = "given"

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        see, names = self.observations, [one.camera.name for one in self.cameras]
        for what, index, count, least in (
            ("observations.camera", see.camera, len(names), 0),
            ("observations.point", see.point, len(self.points), 0),
            ("observations.placement", see.placement, len(self.placements), -1),
            ("distances.first", self.distances.first, len(self.points), 0),
            ("distances.second", self.distances.second, len(self.points), 0),
        ):
            index = np.asarray(index)
            if len(index) and (index.min() < least or index.max() >= count):
                raise ValueError(f"{what}: {index.min()} to {index.max()} given, {least} to {count - 1} allowed")
        for k, one in enumerate(self.cameras):
            if names.index(one.camera.name) < k:
                raise InputError(f"camera name '{one.camera.name}' stands twice; give each camera its own name")
