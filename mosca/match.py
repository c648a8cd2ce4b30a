"""Which images in different cameras are the same target: epipolar geometry over any number of cameras.

Mosca paper, section 3.2: the ray of a target in one camera appears as an epipolar line in another; targets
on that line are candidates, and further cameras decide where the lines meet. "On the line" is judged by the
covariances of both detections, never by a fixed number of pixels.

``hypotheses`` lists every consistent group (a group for each candidate pair, widened to all cameras
that agree); ``choose`` takes a set of them in which no detection serves twice, larger and better groups first,
and lets the tracks' predictions decide what two cameras alone leave open.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from mosca.data.arrays import Array
from mosca.data.tracks import Points
from mosca.match_search import HALF_HIDDEN, ODD_SHIFT, search, solve_members
from mosca.triangulate import Bundle

RAY_BONUS = 12.0
"""What a further ray is worth when groups compete, in log-likelihood."""
MERGED = 1.3
"""Area over a target's from which an image is taken for two targets."""
CLEARLY_WORSE = 9.0
"""A pair whose squared error is larger by this (3 standard deviations) does not contest another."""


@dataclass(frozen=True)
class MatchSettings:
    """``gate_sigma``: how many standard deviations a ray may pass beside the point. ``camera_sigma_px``: random
    error of image points besides detection noise (body, trigger, lens model), an axis. ``minimum_cameras``: smallest
    group. ``support_sigma``: how near a track's prediction supports a group. ``outlier_sigma``: a group of three
    and more loses its worst ray beyond this. ``worst_sigma_m``: a point whose largest standard deviation exceeds
    this is none (two cameras that face each other, an image of odd size). ``judge_sizes``: whether all targets are
    of one size, so that an image of odd size is partly hidden or merged and is trusted less; not for particles.
    """

    gate_sigma: float = 4.5
    camera_sigma_px: float = 0.06
    minimum_cameras: int = 2
    support_sigma: float = 4.0
    outlier_sigma: float = 4.0
    worst_sigma_m: float = math.inf
    judge_sizes: bool = True


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Groups of rays that may be one target; they may share rays.

    ``xyz`` (n, 3), ``covariance`` (n, 3, 3), ``chi2`` (n,) sum of squared whitened errors, ``rays`` (n, c) row of
    the bundle that each camera contributes, or -1; ``trust`` (n, c) factor on each ray's whitened error;
    ``diameter_m`` (n,) of the target from its largest image.
    """

    xyz: Array
    covariance: Array
    chi2: Array
    rays: Array
    trust: Array
    diameter_m: Array

    def select(self, rows: Array) -> "Hypotheses":
        """Return the groups that a mask or an index array names."""
        return Hypotheses(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class Predicted:
    """Where the tracks expect their targets: ``xyz`` (k, 3), ``covariance`` (k, 3, 3)."""

    xyz: Array
    covariance: Array

    @classmethod
    def nothing(cls) -> "Predicted":
        """No expectation: every frame on its own."""
        return cls(np.empty((0, 3)), np.empty((0, 3, 3)))


def hypotheses(
    bundle: Bundle, settings: MatchSettings, volume: tuple[Array, Array], typical_diameter_m: float = 0.0
) -> Hypotheses:
    """Return every group of rays from at least two cameras that meet within ``volume`` (low (3,), high (3,)) [m].

    ``typical_diameter_m``: of the targets, as far as it is known (0: compare the images of a group alone). An
    image too small for it is a target partly hidden, one too large is merged with another; the centroid is
    shifted by about ``share of the area x radius``: the ray counts for less and is searched for farther away.
    """
    found = Hypotheses(*search(
        bundle.origin, bundle.start, bundle.direction, bundle.white, bundle.spread, bundle.sigma_px,
        bundle.radius_px, bundle.angle, settings.gate_sigma, settings.outlier_sigma,
        np.asarray(volume[0], dtype=float), np.asarray(volume[1], dtype=float), typical_diameter_m,
        settings.judge_sizes,
    ))  # fmt: skip
    enough = (found.rays >= 0).sum(axis=1) >= settings.minimum_cameras
    if math.isfinite(settings.worst_sigma_m):
        enough &= np.linalg.eigvalsh(found.covariance)[:, -1] <= settings.worst_sigma_m**2
    return found.select(enough)


def choose(
    found: Hypotheses,
    bundle: Bundle,
    predicted: Predicted,
    settings: MatchSettings,
    typical_diameter_m: float = 0.0,
) -> Points:
    """Return groups that share no ray, best first.

    A group's worth: so much a ray, so much for a track that expects it there (each track speaks for one group),
    less its squared errors. A group that loses rays to a better one is tried again with those it has left. An image
    too large for one target of ``typical_diameter_m`` shows two, and serves a second group if a track speaks for it.
    A pair without support is taken only where no other such pair that meets about as well wants one of its
    rays: two cameras cannot tell, time will.
    """
    used = np.zeros(len(bundle.direction), dtype=np.int64)
    spoken = np.zeros(len(predicted.xyz), dtype=bool)
    taken = []
    for _ in range(len(bundle.origin) - 1):
        if len(found) == 0:
            break
        count = (found.rays >= 0).sum(axis=1)
        track, support = _support(found, predicted, settings.support_sigma)
        order = np.argsort(0.5 * found.chi2 - RAY_BONUS * count - support, kind="stable")
        found = found.select(order)
        merged = _merged(found, bundle, typical_diameter_m if settings.judge_sizes else 0.0)
        mask = _take(found.rays, merged, track[order], count[order], used, spoken)
        taken.append(found.select(mask))
        found = _left_over(found.select(~mask), bundle, used, settings)
    taken.append(found.select(_uncontested(found.rays, found.chi2, used)))
    return _points(taken, bundle)


def _merged(found: Hypotheses, bundle: Bundle, typical_diameter_m: float) -> Array:
    """Return which images (n, c) are too large for one target."""
    if typical_diameter_m <= 0.0 or len(found) == 0:
        return np.zeros(found.rays.shape, dtype=bool)
    distance = np.linalg.norm(found.xyz[:, None] - bundle.origin[None], axis=2)
    size = bundle.angle[found.rays] * distance
    return (found.rays >= 0) & (size**2 > MERGED * typical_diameter_m**2)


def _points(groups: list[Hypotheses], bundle: Bundle) -> Points:
    xyz, covariance, chi2, rays, trust, diameter = (
        np.concatenate([getattr(g, name) for g in groups]) for name in Hypotheses.__dataclass_fields__
    )
    count = (rays >= 0).sum(axis=1)
    sigma = (
        np.where(rays >= 0, bundle.sigma_px[rays] / trust, 0.0)
        if len(bundle.sigma_px)
        else np.zeros(rays.shape)
    )
    scale = np.sqrt((sigma**2).sum(axis=1) / np.maximum(count, 1))
    residual = scale * np.sqrt(chi2 / np.maximum(2 * count, 1))
    return Points(
        xyz,
        covariance,
        count,
        residual,
        np.where(rays >= 0, rays - bundle.start[:-1], -1),
        diameter,
        _whole_images(rays, trust, bundle).sum(axis=1),
    )


def _whole_images(rays: Array, trust: Array, bundle: Bundle) -> Array:
    """Return for each group and camera (n, c) how whole its image is: 1 of the right size, 0 half hidden."""
    if len(bundle.sigma_px) == 0:
        return np.zeros(rays.shape)
    shift = bundle.sigma_px[rays] * np.sqrt(2.0 * (1.0 / trust**2 - 1.0))  # undoes search's trust
    odd = shift / (ODD_SHIFT * bundle.radius_px[rays])
    return np.where(rays >= 0, np.clip(1.0 - odd / HALF_HIDDEN, 0.0, 1.0), 0.0)


def _left_over(found: Hypotheses, bundle: Bundle, used: Array, settings: MatchSettings) -> Hypotheses:
    """Return the groups without the rays that are used up, solved anew where they lost some."""
    rays = np.where((found.rays >= 0) & (used[found.rays] == 0), found.rays, -1)
    left = (rays >= 0).sum(axis=1)
    lost = left < (found.rays >= 0).sum(axis=1)
    again = lost & (left >= settings.minimum_cameras)
    xyz, covariance, chi2 = _solve_all(
        rays[again], found.trust[again], bundle.origin, bundle.direction, bundle.white
    )
    solved = Hypotheses(xyz, covariance, chi2, rays[again], found.trust[again], found.diameter_m[again])
    solved = solved.select((solved.chi2 >= 0) & (solved.chi2 <= settings.gate_sigma**2))
    both = zip(
        (getattr(found.select(~lost), name) for name in Hypotheses.__dataclass_fields__),
        (getattr(solved, name) for name in Hypotheses.__dataclass_fields__),
        strict=True,
    )
    return Hypotheses(*(np.concatenate(pair) for pair in both))


def _support(found: Hypotheses, predicted: Predicted, gate: float) -> tuple[Array, Array]:
    """Return for each hypothesis the track (n,) that speaks for it, or -1, and how much that is worth (n,).

    The worth is the log-likelihood ratio of "this track's target" against "a chance meeting of rays", chance
    meetings being as dense as hypotheses are: a track that has not been seen for long expects its target
    everywhere and says little.
    """
    track, support = np.full(len(found), -1), np.zeros(len(found))
    if len(predicted.xyz) == 0:
        return track, support
    spread = np.ptp(np.concatenate([found.xyz, predicted.xyz]), axis=0)
    density = len(found) / max(float(np.prod(spread)), 1e-9 * float(spread.max()) ** 3, 1e-18)
    near = min(4, len(predicted.xyz))
    _, index = cKDTree(predicted.xyz).query(found.xyz, k=[*range(1, near + 1)])
    for neighbour in index.T:
        offset = found.xyz - predicted.xyz[neighbour]
        total = found.covariance + predicted.covariance[neighbour]
        distance2 = np.einsum("ni,ni->n", offset, np.linalg.solve(total, offset[:, :, None])[:, :, 0])
        log_volume = 0.5 * np.linalg.slogdet(2 * np.pi * total)[1]
        worth = np.where(distance2 < gate**2, -np.log(density) - log_volume - 0.5 * distance2, 0.0)
        better = worth > support
        track[better], support[better] = neighbour[better], worth[better]
    return track, support


@njit(nogil=True, cache=True)
def _take(rays, merged, track, count, used, spoken):  # type: ignore[no-untyped-def]
    """Take groups in order as long as their rays are free; pairs only if a track, still free, speaks for them."""
    taken = np.zeros(rays.shape[0], dtype=np.bool_)
    for n in range(rays.shape[0]):
        alone = track[n] < 0 or spoken[track[n]]
        if alone and count[n] == 2:
            continue
        free = True
        for c in range(rays.shape[1]):
            if rays[n, c] >= 0 and used[rays[n, c]] > (1 if merged[n, c] and not alone else 0):
                free = False
        if not free:
            continue
        taken[n] = True
        if track[n] >= 0:
            spoken[track[n]] = True
        for c in range(rays.shape[1]):
            if rays[n, c] >= 0:
                used[rays[n, c]] += 1
    return taken


@njit(nogil=True, cache=True)
def _uncontested(rays, chi2, used):  # type: ignore[no-untyped-def]
    """Take the pairs whose rays no other free pair wants that meets about as well."""
    taken = np.zeros(rays.shape[0], dtype=np.bool_)
    for n in range(rays.shape[0]):
        taken[n] = _free(rays[n], used)
        for k in range(rays.shape[0]):
            if k != n and taken[n] and chi2[k] < chi2[n] + CLEARLY_WORSE and _free(rays[k], used):
                for c in range(rays.shape[1]):
                    if rays[n, c] >= 0 and rays[n, c] == rays[k, c]:
                        taken[n] = False
    return taken


@njit(nogil=True, cache=True)
def _solve_all(rays, trust, origin, direction, white):  # type: ignore[no-untyped-def]
    """Solve groups anew: points (n, 3), covariances (n, 3, 3), squared errors (n,), -1 where rays do not meet."""
    xyz, covariance = np.zeros((rays.shape[0], 3)), np.zeros((rays.shape[0], 3, 3))
    chi2 = np.empty(rays.shape[0])
    for n in range(rays.shape[0]):
        chi2[n] = solve_members(rays[n], trust[n], origin, direction, white, xyz[n], covariance[n])
    return xyz, covariance, chi2


@njit(nogil=True, cache=True)
def _free(members, used):  # type: ignore[no-untyped-def]
    taken = 0
    for c in range(members.shape[0]):
        if members[c] >= 0 and used[members[c]] > 0:
            taken += 1
    return taken == 0
