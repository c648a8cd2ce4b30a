"""What one exposure looks at, in the form that the kernels read: its window of time, and the targets."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from twin.scenes.figure import Figure

ALWAYS = (-np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class Window:
    """How a frame's rows expose, in seconds from the opening of the first row.

    ``nodes_s`` (K,) instants at which paths are given, from the first row's opening to the last one's closing
    (K >= 3); ``length_s`` of a row's exposure; ``row_time_s`` from row to row (0: global shutter);
    ``light_s``: when the strobe is on.
    """

    nodes_s: Array
    length_s: float
    row_time_s: float = 0.0
    light_s: tuple[float, float] = ALWAYS


@dataclass(frozen=True, eq=False)
class Figures:
    """The figures of a scene: ``pieces`` (n, 7) of all, those of figure f from ``first[f]`` to ``first[f + 1]``."""

    pieces: Array
    first: Array

    @classmethod
    def of(cls, figures: "tuple[Figure, ...]") -> "Figures":
        """Return ``figures`` in the form that the kernels read."""
        counts = [len(f.pieces) for f in figures]
        pieces = np.concatenate([f.pieces for f in figures]) if figures else np.zeros((0, 7))
        return cls(np.ascontiguousarray(pieces), np.concatenate([[0], np.cumsum(counts)]).astype(np.int64))


NO_FIGURES = Figures(np.zeros((0, 7)), np.zeros(1, dtype=np.int64))


@dataclass(frozen=True, eq=False)
class TargetsInCamera:
    """Targets as one exposure sees them, camera frame [m].

    ``path`` (m, K, 3): centres at the window's nodes; ``turn`` (m, K, 3, 3): target's axes -> camera frame (its
    normal is the third column); ``radius`` (m,) (a figure's: of the disc that encloses it); ``shape`` (m,)
    BALL, FLAT or FIGURE; ``figure`` (m,) its number in Figures, or -1; ``electrons`` (m,) that a pixel fully
    covered by it collects in the window's length; ``lit_s`` (m, 2) when it shines; ``limb`` (m,) share of
    brightness that the rim lacks; ``shade`` (m, 3) change of brightness from the middle to the rim.
    """

    path: Array
    turn: Array
    radius: Array
    shape: Array
    figure: Array
    electrons: Array
    lit_s: Array
    limb: Array
    shade: Array

    @classmethod
    def plain(
        cls, path: Array, turn: Array, radius: Array, shape: Array, electrons: Array
    ) -> "TargetsInCamera":
        """Return balls and flat targets that are evenly bright and shine all the time."""
        m = len(path)
        return cls(
            np.ascontiguousarray(path, dtype=float),
            np.ascontiguousarray(turn, dtype=float),
            np.ascontiguousarray(radius, dtype=float),
            np.ascontiguousarray(shape, dtype=np.int64),
            np.full(m, -1, dtype=np.int64),
            np.ascontiguousarray(electrons, dtype=float),
            np.tile(np.array(ALWAYS), (m, 1)),
            np.zeros(m),
            np.zeros((m, 3)),
        )
