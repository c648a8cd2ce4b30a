"""Common views of cameras: initial pairs, unconnected groups, and the common radial distortion of their lenses."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components

from mosca.calibration.initial.projective import Robust, fundamental, plane_misfit
from mosca.calibration.uncalibrated.image_points import PointViews
from mosca.data.arrays import Array
from mosca.errors import CalibrationError

FEWEST_COMMON = 20
"""Fewest object points that both of two cameras must have seen to count as joined."""
FEWEST_POINTS = 30
"""Fewest object points that a camera must share with others to be calibrated."""
BENDS = (-0.35, -0.25, -0.16, -0.1, -0.05, -0.02, 0.0, 0.02, 0.06)
"""Bends of lenses that are tried (``PointViews.plain``): from a wide lens's barrel to a slight cushion."""
LEAST_INLIERS = 0.5
"""Least share of a pair's common images that its epipolar geometry must explain."""
# how much worse a homography must fit than the fundamental matrix, and how badly at least [half diagonals]
FLAT, LEAST_PARALLAX = 5.0, 2e-3
LITTLE_DEPTH = (
    "little-depth: the points lie in one plane or the cameras stand at one place, so that focal lengths and "
    "distances look alike; wave through the depth of the volume"
)


def check_links(tracks: PointViews) -> None:
    """Raise CalibrationError for cameras that saw too little, and for groups of cameras that no common view joins."""
    common = tracks.common()
    shared = np.bincount(tracks.of_cameras(range(len(tracks.names))).camera, minlength=len(tracks.names))
    for name, points in zip(tracks.names, shared.tolist(), strict=True):
        if points < FEWEST_POINTS and len(tracks.names) > 1:
            raise CalibrationError(
                f"no-link: camera '{name}' shares {points} points with other cameras, {FEWEST_POINTS} at least are "
                "needed; wave longer where it and another camera both see",
                (name,),
            )
    groups, group_of = connected_components(common >= FEWEST_COMMON, directed=False)
    if groups > 1:
        most_seen = group_of[np.argmax(common.sum(axis=1))]
        refuse_groups(tracks.names, set(np.flatnonzero(group_of == most_seen).tolist()))


def refuse_groups(names: Sequence[str], group: set[int], why: str = "no common view joins") -> None:
    """Raise CalibrationError that names both groups of cameras."""
    inside = [name for k, name in enumerate(names) if k in group]
    outside = [name for k, name in enumerate(names) if k not in group]
    raise CalibrationError(
        f"no-link: {why} cameras {', '.join(outside)} with {', '.join(inside)}; wave the target where one of each "
        "group sees it at the same time",
        tuple(outside if len(outside) <= len(inside) else inside),
    )


def pair_geometry(
    tracks: PointViews, first: int, second: int, bend: float, rng: np.random.Generator, samples: int = 300
) -> tuple[Array, Array, Array, Robust]:
    """Return common points (m,), their plain image points (m, 2) in both cameras, and the fundamental matrix."""
    table = tracks.table()
    both = np.flatnonzero((table[first] >= 0) & (table[second] >= 0))
    x, y = (tracks.plain(k, tracks.xy_px[table[k, both]], bend) for k in (first, second))
    return both, x, y, fundamental(x, y, rng, samples)


def flat(x: Array, y: Array, found: Robust, rng: np.random.Generator) -> bool:
    """Return whether a homography fits two cameras' points nearly as well as their fundamental matrix does.

    Then the points lie in one plane, or the cameras are at one position, and the fundamental matrix is arbitrary.
    """
    parallax = plane_misfit(x[found.inliers], y[found.inliers], rng)
    return parallax < FLAT * max(found.median, LEAST_PARALLAX / FLAT)


def strongest_pairs(tracks: PointViews, most: int) -> list[tuple[int, int]]:
    """Return up to ``most`` pairs of cameras, those with most common points first."""
    common = np.triu(tracks.common(), 1)
    pairs = np.argwhere(common >= FEWEST_COMMON)
    order = np.argsort(-common[pairs[:, 0], pairs[:, 1]], kind="stable")
    return [(int(a), int(b)) for a, b in pairs[order[:most]]]


def common_bend(tracks: PointViews, rng: np.random.Generator) -> float:
    """Return the bend that lets the strongest pairs' fundamental matrices fit best.

    CalibrationError where half of the common points contradict in each of them: frames or cameras are mixed up.
    """
    pairs = strongest_pairs(tracks, 3)
    misfit = np.zeros((len(pairs), len(BENDS)))
    for p, (first, second) in enumerate(pairs):
        for b, bend in enumerate(BENDS):
            misfit[p, b] = pair_geometry(tracks, first, second, bend, rng, samples=120)[3].median
    relative = misfit / misfit.min(axis=1, keepdims=True).clip(1e-9)
    return BENDS[int(np.argmin(relative.sum(axis=0)))]
