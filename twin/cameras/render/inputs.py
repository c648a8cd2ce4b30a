"""The inputs of rendering: the exposure's window of time, the targets with their figures, the kernels' arguments.

Kernels take NamedTuples, which cost nothing in Numba: those of one exposure (``RenderInputs``), of one target at one
instant (``TargetPose``), and of the solids that may hide it (``NearSolids``).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from twin.cameras.exposure.lighting import ALWAYS
from twin.scenes.figure import Figure


@dataclass(frozen=True, eq=False)
class Window:
    """When a frame's rows are exposed, in seconds from the opening of the first row."""

    nodes_s: Array
    """(K,) instants at which paths are given, from the first row's opening to the last one's closing; K >= 3."""
    length_s: float
    """Exposure of one row."""
    row_time_s: float = 0.0
    """From the opening of one row to the next (0: global shutter)."""
    light_s: tuple[float, float] = ALWAYS
    """When the strobe is on: from, until."""


@dataclass(frozen=True, eq=False)
class Figures:
    """The figures of a scene: ``pieces`` (n, 7); those of figure f go from ``first[f]`` to ``first[f + 1]``."""

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
    """Targets as one exposure sees them, camera frame [m]."""

    path: Array
    """(m, K, 3): centres at the window's nodes."""
    rotation: Array
    """(m, K, 3, 3): target's axes -> camera frame; its normal is the third column."""
    radius: Array
    """(m,); for a figure, the radius of the disc that encloses it."""
    shape: Array
    """(m,): BALL, FLAT or FIGURE."""
    figure: Array
    """(m,): number in Figures, or -1."""
    electrons: Array
    """(m,): electrons that a pixel fully covered by the target collects in the window's length."""
    lit_s: Array
    """(m, 2): when the target shines."""
    limb: Array
    """(m,): share of brightness that the rim lacks."""
    shade: Array
    """(m, 3): change of brightness from the middle to the rim."""
    fade_rad: Array
    """(m, 2): angles off a ball's normal at which its light begins to fade and ends; beyond pi / 2: no fading."""


class RowTiming(NamedTuple):
    """When rows are exposed and lit, in seconds from the opening of the first row."""

    length_s: float
    row_time_s: float
    on_s: float
    off_s: float


class TargetArrays(NamedTuple):
    """The arrays of ``TargetsInCamera``; ``profile`` (m, 6): limb, shade, fade."""

    path: Array
    rotation: Array
    radius: Array
    shape: Array
    figure: Array
    electrons: Array
    lit_s: Array
    profile: Array


class SolidArrays(NamedTuple):
    """The occluding primitives (k,) and their poses in the camera frame at the window's K nodes."""

    kind: Array
    """(k,): MuJoCo's type of each geom."""
    size: Array
    """(k, 3): MuJoCo's size of each geom [m]."""
    marker: Array
    """(k,): number of the target that the geom represents, or -1."""
    xyz: Array
    """(K, k, 3) [m]."""
    rotation: Array
    """(K, k, 3, 3): geom -> camera frame."""
    bounds: Array
    """(k, 8): the capsule that encloses all of a geom's motion, see ``motion_bounds``."""


class RenderInputs(NamedTuple):
    """All inputs for rendering one exposure of one camera."""

    lens: Array
    """Parameter vector, see ``twin.cameras.optics.lens_vector``."""
    pixel_taps: Array
    """How light spreads to pixels, see ``twin.cameras.optics.pixel_kernel``."""
    pixel_reach: int
    """Distance beyond which a pixel collects nothing [px]."""
    blur_terms: Array
    """(9,): terms of the blur, see ``twin.cameras.optics.psf.Psf``."""
    nodes_s: Array
    """(K,): instants at which paths are given."""
    rows: RowTiming
    targets: TargetArrays
    figure_pieces: Array
    figure_first: Array
    solids: SolidArrays


class TargetPose(NamedTuple):
    """A target at one instant: ``shape``, ``rotation`` (3, 3) to the camera frame, centre in it, and radius [m]."""

    shape: int
    rotation: Array
    x: float
    y: float
    z: float
    radius: float


class ImageBox(NamedTuple):
    """The rectangle that encloses an image [px]."""

    left: float
    right: float
    top: float
    bottom: float


class Solid(NamedTuple):
    """One occluder at one instant: type and size as MuJoCo has them, centre (3,), rotation (3, 3) to the camera."""

    kind: int
    size: Array
    xyz: Array
    rotation: Array


class NearSolids(NamedTuple):
    """The solids that may hide a target, and their poses at one instant, overwritten from instant to instant."""

    number: Array
    """(k,): their numbers, in the first ``found`` elements."""
    found: int
    """Number of solids found."""
    kind: Array
    """(k,): MuJoCo's geom type of all solids."""
    size: Array
    """(k, 3): MuJoCo's size of all solids [m]."""
    xyz: Array
    """(k, 3): centres of those found, camera frame [m]."""
    rotation: Array
    """(k, 3, 3): rotations of those found, geom -> camera frame."""
