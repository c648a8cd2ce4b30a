"""Two cameras of unknown focal length from a wand: the pair of focal lengths that makes the wand one length.

The fundamental matrix leaves two numbers of two cameras open, their focal lengths, and leaves even these undetermined
where the optical axes meet, as they do in most volumes. The wand's length, the same in each frame, settles both:
all pairs of focal lengths within reason are tried (calibrated relative orientation after Longuet-Higgins 1981; the
wand as a scale bar after Mitchelson and Hilton 2003).
"""

from dataclasses import dataclass

import numpy as np

from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_1D
from mosca.calibration.initial.projective import FOCAL_RANGE, minima
from mosca.data.arrays import Array
from mosca.data.rig import Pose

GRID = 24
# wands examined while trying
MOST_WANDS = 60
# cost of points behind a camera, as a relative variation of the wand's length
BEHIND = 2.0


@dataclass(frozen=True, eq=False)
class PairGuess:
    """Relative orientation: ``focal`` (2,) in half diagonals, pose of the second camera in the first's frame [m],
    ``spread``: by how much the wand's length varies (robust standard deviation over the length).
    """

    focal: tuple[float, float]
    first_from_second: Pose
    spread: float


def pair_guesses(
    fundamental: Array, first: Array, second: Array, length_m: Array, focal_first: float | None = None, most: int = 4
) -> list[PairGuess]:
    """Return the likeliest focal lengths and relative orientations of two cameras, the best first.

    ``fundamental`` (3, 3), second^T F first = 0; ``first``, ``second`` (w, 2, 2): plain image points of both ends
    of w wands; ``length_m`` (w,) their known length; ``focal_first``: where it is known.
    """
    step = max(1, len(first) // MOST_WANDS)
    first, second, length = first[::step], second[::step], length_m[::step]
    own = np.geomspace(*FOCAL_RANGE, GRID)
    known = np.array([focal_first]) if focal_first is not None else own
    f1, f2 = (side.ravel() for side in np.meshgrid(known, own, indexing="ij"))
    rotations, shifts = motions(fundamental, f1, f2)
    cost, scale, sign = _scores(rotations, shifts, f1, f2, first, second, length)
    # the better of the two rotations
    better = np.argmin(cost, axis=1)
    rows = np.arange(len(f1))
    value = cost[rows, better].reshape(len(known), GRID)
    found = []
    for i, j in minima(value)[:most]:
        k = i * GRID + j
        turn = rotations[k, better[k]]
        shift = shifts[k] * scale[k, better[k]] * sign[k, better[k]]
        pose = Pose(turn.T, -turn.T @ shift)
        found.append(PairGuess((float(f1[k]), float(f2[k])), pose, float(value[i, j])))
    return found


def motions(fundamental: Array, f1: Array, f2: Array) -> tuple[Array, Array]:
    """Return both rotations (g, 2, 3, 3) second_from_first and unit shift (g, 3) for each pair of focal lengths."""
    k1 = np.stack([f1, f1, np.ones_like(f1)], axis=1)
    k2 = np.stack([f2, f2, np.ones_like(f2)], axis=1)
    essential = k2[:, :, None] * fundamental * k1[:, None, :]
    left, _, right = np.linalg.svd(essential)
    left = left * np.sign(np.linalg.det(left))[:, None, None]
    right = right * np.sign(np.linalg.det(right))[:, None, None]
    quarter = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    return np.stack([left @ quarter @ right, left @ quarter.T @ right], axis=1), left[:, :, 2]


def _scores(
    rotations: Array, shifts: Array, f1: Array, f2: Array, first: Array, second: Array, length: Array
) -> tuple[Array, Array, Array]:
    """Return cost, scale [m] and sign of the shift (g, 2) of each motion."""
    w = len(first)
    x1 = np.concatenate([first[:, 0], first[:, 1]])
    x2 = np.concatenate([second[:, 0], second[:, 1]])
    a = np.concatenate([x1[None] / f1[:, None, None], np.ones((len(f1), 2 * w, 1))], axis=2)[:, None]
    b = np.concatenate([x2[None] / f2[:, None, None], np.ones((len(f2), 2 * w, 1))], axis=2)[:, None]
    # in the second camera's frame: s R a + t = r b, least squares in the depths s, r
    a = a @ np.swapaxes(rotations, 2, 3)
    t = shifts[:, None, None, :]
    aa, bb, ab = (a * a).sum(axis=3), (b * b).sum(axis=3), (a * b).sum(axis=3)
    at, bt = (a * t).sum(axis=3), (b * t).sum(axis=3)
    det = np.maximum(aa * bb - ab * ab, 1e-12 * aa * bb)
    s, r = (-at * bb + bt * ab) / det, (bt * aa - at * ab) / det
    points = (s[..., None] * a + t + r[..., None] * b) / 2
    gap = np.linalg.norm(s[..., None] * a + t - r[..., None] * b, axis=3)
    measured = np.linalg.norm(points[:, :, :w] - points[:, :, w:], axis=3)
    ratio = np.maximum(measured, 1e-12) / length
    middle = np.median(ratio, axis=2)
    spread = SIGMA_BY_MEDIAN_1D * np.median(np.abs(np.log(ratio / middle[..., None])), axis=2)
    front = ((s > 0) & (r > 0)).mean(axis=2)
    back = ((s < 0) & (r < 0)).mean(axis=2)
    miss = np.median(gap, axis=2) / middle / np.median(length)
    cost = spread + miss + BEHIND * (1 - np.maximum(front, back))
    return cost, 1 / middle, np.where(front >= back, 1.0, -1.0)
