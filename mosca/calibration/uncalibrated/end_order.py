"""Order of a wand's ends where its balls do not determine it: two balls, or a symmetric wand.

The middle of the balls' images is nearly the image of the wand's middle, whichever end is first. It gives rough
epipolar lines, which determine the ends that belong together in two cameras. The balls then give more accurate lines.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mosca.calibration.initial.projective import epipolar_distance, fundamental
from mosca.calibration.uncalibrated.image_points import PointViews, point_views
from mosca.calibration.uncalibrated.view_graph import FEWEST_COMMON, common_bend
from mosca.data.arrays import Array
from mosca.data.rig import Lens
from mosca.data.sightings import Sightings
from mosca.errors import InputError

ROUNDS = 3
# an order is sure where the other misses the epipolar lines by so many times more, and by so many typical misses
TIMES_WORSE, CLEARLY = 4.0, 6.0


def ordered(sightings: Sightings, balls: int, lenses: Sequence[Lens], rng: np.random.Generator) -> Sightings:
    """Return the sightings with unknown marks (-1) numbered along the wand, alike in all cameras of a frame.

    The rows of an image are in their order along the line. Which end has number 0 is arbitrary; images whose order
    is undetermined have -1.
    """
    unknown = sightings.mark < 0
    if not unknown.any():
        return sightings
    if not unknown.all():
        raise InputError(
            "sightings: some marks have a number and some have -1; the balls of a wand have either all or none"
        )
    image = sightings.frame * len(sightings.cameras) + sightings.camera
    order = np.argsort(image, kind="stable")
    keys, counts = np.unique(image, return_counts=True)
    if (counts != balls).any():
        bad = int(keys[np.argmax(counts != balls)])
        raise InputError(
            f"sightings: camera '{sightings.cameras[bad % len(sightings.cameras)]}', frame "
            f"{bad // len(sightings.cameras)}: {counts[counts != balls][0]} points given; all {balls} balls of the "
            "wand, or none, are wanted of an image"
        )
    frame, camera = np.divmod(keys, len(sightings.cameras))
    ends = sightings.xy_px[order].reshape(-1, balls, 2)
    flips = _flips(_middles(sightings, frame, camera, ends, lenses), ends, rng)
    number = np.arange(balls)
    marks = np.where(flips[:, None] > 0, number, balls - 1 - number)
    marks[flips == 0] = -1
    mark = np.empty(len(sightings), dtype=np.int64)
    mark[order] = marks.ravel()
    return replace(sightings, mark=mark)


def _middles(sightings: Sightings, frame: Array, camera: Array, ends: Array, lenses: Sequence[Lens]) -> PointViews:
    """Return the middles of the balls' images as tracks, one a frame."""
    n = len(frame)
    middles = replace(
        sightings,
        camera=camera,
        frame=frame,
        mark=np.zeros(n, dtype=np.int64),
        xy_px=ends.mean(axis=1),
        covariance_px2=np.tile(np.eye(2), (n, 1, 1)),
        diameter_px=np.full(n, np.nan),
        ellipticity=np.zeros((n, 2)),
        ellipticity_sigma=np.zeros(n),
    )
    return point_views(middles, 1, lenses)


def _flips(middles: PointViews, ends: Array, rng: np.random.Generator) -> Array:
    """Return +1 or -1 (n,) for each image so that all images of a frame agree, 0 where unknown."""
    bend = common_bend(middles, rng)
    table, common = middles.table(), middles.common()
    votes = []
    for first in range(len(middles.names)):
        for second in range(first + 1, len(middles.names)):
            if common[first, second] >= FEWEST_COMMON:
                both = np.flatnonzero((table[first] >= 0) & (table[second] >= 0))
                a, b = table[first, both], table[second, both]
                x, y = (middles.plain(k, ends[i], bend) for k, i in ((first, a), (second, b)))
                votes.append(_votes(a, b, x, y, rng))
    out = np.zeros(len(ends), dtype=np.int64)
    if votes:
        edges = np.concatenate(votes)
        _spread(edges[np.argsort(-np.abs(edges[:, 2]), kind="stable")], out)
    return out


def _votes(a: Array, b: Array, x: Array, y: Array, rng: np.random.Generator) -> Array:
    """Return rows (v, 3): image of the first camera, image of the second, how clearly their orders are alike (+) or
    opposite (-); ``x``, ``y`` (m, k, 2) plain image points of the balls.
    """
    found = fundamental(x.mean(axis=1), y.mean(axis=1), rng)
    ends = [0, x.shape[1] - 1]
    x, y = x[:, ends], y[:, ends]
    sign = np.ones(len(x), dtype=np.int64)
    clear = np.zeros(len(x))
    for _ in range(ROUNDS):
        same, other = (
            np.hypot(*(epipolar_distance(found.matrix, x[:, k], y[:, j]) for k, j in pairs))
            for pairs in (((0, 0), (1, 1)), ((0, 1), (1, 0)))
        )
        sign = np.where(same <= other, 1, -1)
        least, most = np.minimum(same, other), np.maximum(same, other)
        noise = max(float(np.median(least)), 1e-9)
        clear = np.where((most > TIMES_WORSE * least) & (most > CLEARLY * noise), most / noise, 0.0)
        sure = clear > 0
        if sure.sum() < FEWEST_COMMON:
            break
        turned = np.where(sign[:, None, None] > 0, y, y[:, ::-1])[sure]
        found = fundamental(x[sure].reshape(-1, 2), turned.reshape(-1, 2), rng)
    keep = clear > 0
    return np.column_stack([a[keep], b[keep], (sign * clear)[keep]])


def _spread(edges: Array, out: Array) -> None:
    """Write the flips that the clearest edges give, each group of joined images from its first image on."""
    parent = np.arange(len(out))
    parity = np.ones(len(out), dtype=np.int64)

    def root(k: int) -> tuple[int, int]:
        sign = 1
        while parent[k] != k:
            sign *= int(parity[k])
            k = int(parent[k])
        return k, sign

    size = np.ones(len(out), dtype=np.int64)
    for first, second, vote in edges:
        (a, sign_a), (b, sign_b) = root(int(first)), root(int(second))
        if a != b:
            big, small = (a, b) if size[a] >= size[b] else (b, a)
            parent[small], parity[small] = big, sign_a * sign_b * (1 if vote > 0 else -1)
            size[big] += size[small]
    roots = [root(k) for k in range(len(out))]
    for k, (top, sign) in enumerate(roots):
        out[k] = sign if size[top] >= 2 else 0
