"""Rigid bodies: where their markers sit, and where the bodies were over time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.targets import not_below_zero

BODY_STATUSES = ("measured", "withheld")
"""``withheld``: some markers of the body are seen, but they are too few, or another pose explains them as well."""
FEWEST_MARKERS, MOST_MARKERS = 3, 32
LEAST_OFF_LINE = 0.05
"""Least spread of markers across their best-fitting line, as a share of that along it; below, they are collinear."""


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Named ``markers`` (m) whose centres ``positions`` (m, 3) [m] are fixed in the body's own frame.

    ``sigma_m``: standard deviation of each coordinate [m]. Raises ValueError for fewer than 3 markers, duplicate
    names, and collinear markers, which leave the rotation about their line undetermined.
    """

    name: str
    markers: tuple[str, ...]
    positions: Array
    sigma_m: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "markers", tuple(self.markers))
        m = len(self.markers)
        set_read_only(self, positions=(m, 3))
        not_below_zero("sigma_m", self.sigma_m)
        if not FEWEST_MARKERS <= m <= MOST_MARKERS:
            raise ValueError(f"body '{self.name}': {m} markers given; {FEWEST_MARKERS} to {MOST_MARKERS} are allowed")
        for marker in self.markers:
            if self.markers.count(marker) > 1:
                raise ValueError(f"body '{self.name}': marker '{marker}' stands twice; each has a name of its own")
        if not np.isfinite(self.positions).all():
            raise ValueError(f"body '{self.name}': a marker's place is no finite number; measure it again")
        spread = np.linalg.svd(self.positions - self.positions.mean(axis=0), compute_uv=False)
        if not spread[1] > LEAST_OFF_LINE * spread[0]:
            raise ValueError(f"body '{self.name}': the markers lie in a line; one must stand well off it")

    def distances(self) -> Array:
        """Return the distance (m, m) of each marker from each other [m]."""
        return np.asarray(np.linalg.norm(self.positions[:, None] - self.positions, axis=2))


@dataclass(frozen=True, eq=False)
class BodyPoses:
    """Poses of rigid bodies as columns, one row per body and frame."""

    frame: Array
    """(n,) pulse number."""
    time_ns: Array
    """(n,) mid-exposure."""
    body: Array
    """(n,) str."""
    quaternion: Array
    """(n, 4) wxyz of world_from_body: x_world = R(quaternion) x_body + position; NaN where withheld."""
    position: Array
    """(n, 3) [m] of world_from_body; NaN where withheld."""
    covariance: Array
    """(n, 6, 6) covariance of the position x, y, z [m], then the rotation vector r about the world's x, y, z [rad],
    R_true = exp([r]) R. It contains the errors of the measurement and of the markers' positions, not those of the
    calibration; NaN where withheld."""
    n_markers: Array
    """(n,) number of markers used."""
    residual_m: Array
    """(n,) rms distance of the markers from the fitted model, NaN where unknown."""
    status: Array
    """(n,) one of BODY_STATUSES."""

    def __post_init__(self) -> None:
        n = len(np.asarray(self.frame))
        set_read_only(self, np.int64, frame=(n,), time_ns=(n,), n_markers=(n,))
        set_read_only(self, np.str_, body=(n,), status=(n,))
        set_read_only(self, quaternion=(n, 4), position=(n, 3), covariance=(n, 6, 6), residual_m=(n,))
        unknown = set(np.unique(self.status)) - set(BODY_STATUSES)
        if unknown:
            raise ValueError(f"status: {sorted(unknown)} given, {BODY_STATUSES} allowed")

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def none(cls) -> "BodyPoses":
        """No poses."""
        e, s = np.empty(0), np.empty(0, np.str_)
        return cls(e, e, s, np.empty((0, 4)), np.empty((0, 3)), np.empty((0, 6, 6)), e, e, s)

    def select(self, rows: Array) -> "BodyPoses":
        """Return the poses that a boolean mask or an index array (m,) selects."""
        return BodyPoses(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def of(self, body: str) -> "BodyPoses":
        """Return the measured poses of one body."""
        return self.select((self.body == body) & (self.status == "measured"))


def joined_poses(parts: Sequence[BodyPoses]) -> BodyPoses:
    """Return poses of many instants as one, sorted by frame, then body."""
    parts = [part for part in parts if len(part)]
    if not parts:
        return BodyPoses.none()
    columns = [np.concatenate([getattr(p, name) for p in parts]) for name in BodyPoses.__dataclass_fields__]
    order = np.lexsort((columns[2], columns[0]))
    return BodyPoses(*(column[order] for column in columns))
