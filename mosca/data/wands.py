"""Balls on a stick or a frame: the wand sets the scale, the L-frame sets the world's axes. Lengths in m."""

from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.targets import above_zero, not_below_zero

TELL_APART = 0.02
"""Distances between markers that differ by less than this share of the longest one count as equal."""
MOST_FRAME_MARKERS = 6


@dataclass(frozen=True)
class Wand:
    """Balls on a line, ``along_m`` positions of their centres on it, rising; named wand/1, wand/2, ...

    The wand's x axis is the line, its origin half-way between the first and the last ball.
    """

    along_m: tuple[float, ...]
    diameter_m: float
    sigma_m: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "along_m", tuple(float(x) for x in self.along_m))
        above_zero("diameter_m", self.diameter_m)
        not_below_zero("sigma_m", self.sigma_m)
        if len(self.along_m) < 2:
            raise ValueError(f"along_m = {list(self.along_m)}: two places at least are wanted")
        if not all(b - a > self.diameter_m for a, b in pairwise(self.along_m)):
            raise ValueError(
                f"along_m = {list(self.along_m)}: must rise by more than the balls' diameter {self.diameter_m:g}"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """The balls' names."""
        return tuple(f"wand/{k + 1}" for k in range(len(self.along_m)))

    def positions(self) -> Array:
        """Return the balls' centres (n, 3) in the wand's frame [m]."""
        along = np.array(self.along_m)
        return np.column_stack([along - (along[0] + along[-1]) / 2, np.zeros((len(along), 2))])

    def distances(self) -> Array:
        """Return the distance (n, n) of each ball from each other [m]."""
        along = np.array(self.along_m)
        result: Array = np.abs(along[:, None] - along)
        return result


@dataclass(frozen=True)
class SingleLight:
    """One small light that is waved through the volume. It has no length: ``between`` names two cameras whose centres
    are ``apart_m`` apart [m], which scales the rig; None: lengths are arbitrary.

    ``sigma_px``: standard deviation of an image coordinate; ``pixel_origin``: what (0, 0) is in its image points.
    """

    between: tuple[str, str] | None = None
    apart_m: float = 1.0
    sigma_px: float = 1.0
    pixel_origin: str = "centre"


@dataclass(frozen=True, eq=False)
class LFrame:
    """Balls ``names`` (n) whose centres ``positions`` (n, 3) [m] define the world's axes.

    Raises ValueError for collinear balls, or where two of them could be confused.
    """

    names: tuple[str, ...]
    positions: Array
    diameter_m: float
    sigma_m: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        n = len(self.names)
        set_read_only(self, positions=(n, 3))
        above_zero("diameter_m", self.diameter_m)
        not_below_zero("sigma_m", self.sigma_m)
        if not 3 <= n <= MOST_FRAME_MARKERS:
            raise ValueError(f"{n} markers given; 3 to {MOST_FRAME_MARKERS} are allowed")
        for name in self.names:
            if self.names.count(name) > 1:
                raise ValueError(f"marker '{name}' stands twice; each has a name of its own")
        spread = np.linalg.svd(self.positions - self.positions.mean(axis=0), compute_uv=False)
        if not spread[1] > 0.05 * spread[0]:
            raise ValueError("the markers lie in a line; one must stand well off it")
        twins = look_alike(self.positions)
        if twins is not None:
            first, second = (self.names[k] for k in twins)
            raise ValueError(
                f"markers '{first}' and '{second}' can be taken for each other: distances differ by less than "
                f"{100 * TELL_APART:g} % of the longest; make the arms unlike"
            )


def look_alike(positions: Array) -> tuple[int, int] | None:
    """Return two of the points (n, 3) that can be exchanged (with others) while no distance changes much, or None."""
    distances = np.linalg.norm(positions[:, None] - positions, axis=2)
    for order in permutations(range(len(positions))):
        moved = [k for k, other in enumerate(order) if k != other]
        change = np.abs(distances[np.ix_(order, order)] - distances).max()
        if moved and change < TELL_APART * distances.max():
            return moved[0], order[moved[0]]
    return None
