"""Input of a bundle adjustment: cameras, object points, poses of moving things, observations, lengths, datum.

One convention for every unknown: its standard deviation a priori. 0 holds it at its given value, infinity
leaves it free, anything between weights the given value as an observation of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

from mosca.data.arrays import Array, read_only
from mosca.data.rig import Camera, Pose
from mosca.errors import InputError

FREE = (float("inf"),) * 6
"""A pose with all six unknowns free."""
HELD = (0.0,) * 6
"""A pose held as it is."""
FOCAL = "f_px"
"""Free lens parameter that moves fx and fy together and keeps their ratio (OpenCV's and the fisheye model)."""


@dataclass(frozen=True, eq=False)
class CameraUnknowns:
    """A camera, or a camera at one time: starting values and unknowns.

    Raises ValueError for inconsistent values, InputError for an unknown parameter.
    """

    camera: Camera
    free: tuple[str, ...] = ()
    """Lens parameters to estimate, or "f_px" (fx and fy together)."""
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """name -> (value, standard deviation) of free lens parameters, in their units."""
    pose_sigma: tuple[float, ...] = FREE
    """(6,) a-priori standard deviations of the rotation about the camera's own x, y, z axes [rad] and of its position
    [m] from the starting pose (FREE, HELD or between)."""
    lens_as: str | None = None
    """Name of a previous camera whose lens, ``free`` and ``priors`` this one shares."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "free", tuple(self.free))
        object.__setattr__(self, "pose_sigma", tuple(float(s) for s in self.pose_sigma))
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
        for name, (value, sigma) in self.priors.items():
            if name not in self.free or not np.isfinite(value) or not 0 < sigma < np.inf:
                raise InputError(
                    f"{where}: prior {value:g} +- {sigma:g} of '{name}' given; a finite value and a standard "
                    f"deviation above 0 of a free parameter are wanted ({', '.join(self.free) or 'none is free'})"
                )
        if len(self.pose_sigma) != 6 or not all(s >= 0 for s in self.pose_sigma):
            raise ValueError(f"{where}: pose_sigma = {self.pose_sigma}: six numbers not below 0 are wanted")


@dataclass(frozen=True, eq=False)
class ObjectPoints:
    """Object points ``xyz`` (p, 3) [m] with what is known of them; made by ``free``, ``fixed``, ``weighted``.

    NaN coordinates of a free point: the rays that see it are intersected for a start. ``held`` (p,) bool;
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

    ``rotation`` (f, 3, 3), ``translation`` (f, 3) [m]: starting values; ``sigma`` (f, 6): a-priori standard
    deviations of the rotation about the thing's own axes [rad] and of its position [m], infinite where free
    (default), never 0. A moving camera is modelled with the roles exchanged: the camera fixed at the origin, the
    scene moving.
    """

    rotation: Array
    translation: Array
    sigma: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.translation)
        object.__setattr__(self, "rotation", read_only(self.rotation, (n, 3, 3), "rotation"))
        object.__setattr__(self, "translation", read_only(self.translation, (n, 3), "translation"))
        if self.sigma is not None:
            object.__setattr__(self, "sigma", read_only(self.sigma, (n, 6), "sigma"))
            if not (np.asarray(self.sigma) > 0).all():
                raise ValueError("sigma: above 0 is wanted; a held pose is no placement, move its points instead")

    def __len__(self) -> int:
        return len(self.translation)

    @classmethod
    def of(cls, poses: Sequence[Pose], sigma: Array | None = None) -> "Placements":
        """Return placements with starting values ``poses``."""
        rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
        return cls(rotations, np.array([pose.translation for pose in poses]).reshape(-1, 3), sigma)

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

    ``datum``: "given": what is held or weighted fixes the coordinate system; "points": a free network, whose datum is
    that its points ``datum_points`` (p,) bool (default: all points of the world that are seen) neither shift, rotate
    nor, where no length is known, stretch against their given values (inner constraints, Meissl 1962).
    """

    cameras: tuple[CameraUnknowns, ...]
    observations: Observations
    points: ObjectPoints
    placements: Placements = NO_PLACEMENTS
    distances: Distances = NO_DISTANCES
    datum: Literal["given", "points"] = "given"
    datum_points: Array | None = None

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
            if one.lens_as is not None:
                owner = names.index(one.lens_as) if one.lens_as in names[:k] else None
                if owner is None or self.cameras[owner].lens_as is not None:
                    raise InputError(
                        f"camera '{one.camera.name}': lens_as = '{one.lens_as}'; the name of a camera before it that "
                        "has a lens of its own is wanted"
                    )
        if self.datum_points is not None:
            chosen = read_only(self.datum_points, (len(self.points),), "datum_points", np.bool_)
            object.__setattr__(self, "datum_points", chosen)

    def lens_owner(self) -> Array:
        """Return the camera (c,) whose lens each camera has: its own index where it shares none."""
        names = [one.camera.name for one in self.cameras]
        return np.array(
            [k if one.lens_as is None else names.index(one.lens_as) for k, one in enumerate(self.cameras)],
            dtype=np.int64,
        )
