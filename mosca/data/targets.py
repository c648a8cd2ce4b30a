"""Calibration targets, and the test field and scale bar built of them.

Geometry only, no appearance; boards and wands have their own files. Every target has its own frame: the face's normal
is +z, x to the right and y up for a viewer facing it. Lengths in m; ``sigma_m`` is the a-priori standard deviation of
a coordinate or a length.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mosca.data.arrays import Array, read_only, set_read_only
from mosca.data.target_codes import NUMBERS

RING_INNER, RING_OUTER, PLATE = 2.0, 3.0, 8.0
"""A coded target's usual proportions: the ring's radii and the plate's edge, in radii of the centre dot."""


@dataclass(frozen=True)
class CodedTarget:
    """A white dot within a ring of sectors that encodes ``number`` (``target_codes``), on a square black plate.

    ``dot_radius_m``, ``ring_inner_m`` and ``ring_outer_m`` are radii, ``plate_m`` is the plate's edge.
    """

    number: int
    dot_radius_m: float
    ring_inner_m: float
    ring_outer_m: float
    plate_m: float

    def __post_init__(self) -> None:
        if not 0 <= self.number < NUMBERS:
            raise ValueError(f"number = {self.number} given; coded targets have numbers 0 to {NUMBERS - 1}")
        if not 0 < self.dot_radius_m < self.ring_inner_m < self.ring_outer_m <= self.plate_m / 2 < np.inf:
            raise ValueError(
                f"dot_radius_m = {self.dot_radius_m:g}, ring {self.ring_inner_m:g} to {self.ring_outer_m:g}, "
                f"plate_m = {self.plate_m:g}: the dot must lie within the ring and the ring on the plate"
            )

    @classmethod
    def of_dot(cls, number: int, dot_radius_m: float) -> "CodedTarget":
        """Return a target of the usual proportions."""
        r = dot_radius_m
        return cls(number, r, RING_INNER * r, RING_OUTER * r, PLATE * r)

    @property
    def name(self) -> str:
        """The target's name: its number, three digits."""
        return f"code/{self.number:03d}"


@dataclass(frozen=True)
class RoundTarget:
    """A plain flat disc of ``radius_m``, white as a whole."""

    radius_m: float

    def __post_init__(self) -> None:
        above_zero("radius_m", self.radius_m)


@dataclass(frozen=True)
class BallTarget:
    """A ball of ``diameter_m``; its position is its centre."""

    diameter_m: float

    def __post_init__(self) -> None:
        above_zero("diameter_m", self.diameter_m)


Target = CodedTarget | RoundTarget | BallTarget


@dataclass(frozen=True, eq=False)
class PlacedTarget:
    """A target at ``position`` (3,) [m], facing along ``normal`` (3,), its own x axis along ``x_axis`` (3,).

    Both axes are normalised, and ``x_axis`` is made perpendicular to the normal; None: a level x axis. Raises
    ValueError for a normal without direction or an x axis along it.
    """

    name: str
    target: Target
    position: Array
    normal: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    x_axis: Array | None = None

    def __post_init__(self) -> None:
        set_read_only(self, position=(3,))
        x, _, z = face_axes(self.normal, self.x_axis).T
        object.__setattr__(self, "normal", read_only(z, (3,), "normal"))
        object.__setattr__(self, "x_axis", read_only(x, (3,), "x_axis"))

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3) from the target's axes to the frame of ``position``: columns x axis, y axis, normal."""
        return face_axes(self.normal, self.x_axis)


def face_axes(normal: Array, x_axis: Array | None = None) -> Array:
    """Return the rotation (3, 3) whose columns are x, y and z of a face with ``normal`` (3,).

    x is ``x_axis`` (3,) made perpendicular to the normal; None: level, to the right for a viewer facing it.
    """
    z = _unit(normal, "normal")
    if x_axis is None:
        level = np.array([-z[1], z[0], 0.0])
        x_axis = level if np.linalg.norm(level) > 1e-6 else np.array([1.0, 0.0, 0.0])
    along = _unit(x_axis, "x_axis")
    x = along - (along @ z) * z
    if np.linalg.norm(x) < 1e-3:
        raise ValueError(f"x_axis = {along.tolist()}: lies along the normal; one across it is wanted")
    x = _unit(x, "x_axis")
    return np.stack([x, np.cross(z, x), z], axis=1)


@dataclass(frozen=True, eq=False)
class TestField:
    """Targets at known positions in the field's own frame: a 3D calibration field."""

    __test__: ClassVar[bool] = False  # its name is the field's standard term, not that of a test

    targets: tuple[PlacedTarget, ...]
    sigma_m: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "targets", tuple(self.targets))
        not_below_zero("sigma_m", self.sigma_m)
        if not self.targets:
            raise ValueError("a test field has one target at least")
        for name in self.names:
            if self.names.count(name) > 1:
                raise ValueError(f"target '{name}' stands twice; each has a number or name of its own")

    @property
    def names(self) -> tuple[str, ...]:
        """The targets' names."""
        return tuple(placed.name for placed in self.targets)

    @property
    def positions(self) -> Array:
        """The targets' positions (n, 3) [m]."""
        return np.array([placed.position for placed in self.targets])


@dataclass(frozen=True)
class ScaleBar:
    """Two targets whose centres are ``length_m`` apart by certificate, with standard deviation ``sigma_m``.

    They face along the bar's z axis, at -length_m / 2 and length_m / 2 on its x axis.
    """

    length_m: float
    sigma_m: float
    ends: tuple[Target, Target]

    def __post_init__(self) -> None:
        object.__setattr__(self, "ends", tuple(self.ends))
        above_zero("length_m", self.length_m)
        not_below_zero("sigma_m", self.sigma_m)
        if self.sigma_m >= 0.1 * self.length_m:
            raise ValueError(f"sigma_m = {self.sigma_m:g} given; less than a tenth of length_m is wanted")
        if sum(map(half_width_m, self.ends)) >= self.length_m:
            raise ValueError(f"length_m = {self.length_m:g}: the two targets would overlap")
        if self.names[0] == self.names[1]:
            raise ValueError(f"number {self.names[0][-3:]} stands at both ends; take two numbers")

    @property
    def names(self) -> tuple[str, str]:
        """The targets' names: their numbers, else bar/1 and bar/2."""
        one, two = (end.name if isinstance(end, CodedTarget) else f"bar/{k}" for k, end in enumerate(self.ends, 1))
        return one, two

    def placed(self) -> tuple[PlacedTarget, PlacedTarget]:
        """Return the two targets in the bar's frame."""
        half = np.array([self.length_m / 2, 0.0, 0.0])
        up, right = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        return (
            PlacedTarget(self.names[0], self.ends[0], -half, up, right),
            PlacedTarget(self.names[1], self.ends[1], half, up, right),
        )


def half_width_m(target: Target) -> float:
    """Return how far a target reaches from its centre along its own x axis [m]."""
    match target:
        case CodedTarget(plate_m=edge):
            return edge / 2
        case RoundTarget(radius_m=radius):
            return radius
        case BallTarget(diameter_m=diameter):
            return diameter / 2


def _unit(vector: Array, what: str) -> Array:
    given = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(given))
    if given.shape != (3,) or not 1e-9 < length < 1e9:
        raise ValueError(f"{what} = {given.tolist()} given; a direction (3 numbers, not all zero) is wanted")
    return np.asarray(given / length)


def above_zero(name: str, value: float) -> None:
    """Raise ValueError for a value that is not a finite number above zero."""
    if not 0 < value < np.inf:
        raise ValueError(f"{name} = {value:g} given; a finite number above zero is wanted")


def not_below_zero(name: str, value: float) -> None:
    """Raise ValueError for a value that is not a finite number, zero or above."""
    if not 0 <= value < np.inf:
        raise ValueError(f"{name} = {value:g} given; a finite number, zero or above, is wanted")
