"""Centres of targets that something in front hides in part, from their images and from their points.

Detection fits a disc of any size: what is left of a cut disc is fitted by a smaller one whose centre is off by up to
its radius. Once the image is matched, the target's size and distance say how large its image must be, and the whole
disc's centre follows from the rim that is seen (``mosca.detection.cut_targets.disc``). Blur, size over the expected
one and misfit of whole discs are learned from each camera's whole targets.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import SATURATED, Detections
from mosca.data.frames import FrameSet
from mosca.data.rays import Predicted, RayTable
from mosca.data.rig import Rig, principal_distances_px
from mosca.data.tracks import Points
from mosca.detection.cut_targets.cut_pair import fit_cut_pairs, told_apart
from mosca.detection.cut_targets.disc import (
    AMPLITUDE,
    BLUR,
    BY_RADIUS_X,
    CUT,
    LEAST_CUT,
    MISFIT,
    OTHER_MISFIT,
    OTHER_X,
    RADIUS,
    XX,
    XY,
    YY,
    fit_discs,
)
from mosca.detection.cut_targets.expected import expected_images
from mosca.detection.cut_targets.kinds import BESIDE, GROWN, WHOLE, kinds_of, own_pixels
from mosca.detection.cut_targets.kinds import CUT as CUT_ONE
from mosca.detection.cut_targets.pair import PAIR_AMPLITUDE, PAIR_COVARIANCE, PAIR_MISFIT, fit_pairs

LEARNED_FROM, LEARNED_UP_TO, AT_ONCE = 20, 60, 10
"""Whole discs of a camera: from which on its cut ones are fitted, with which learning ends, most of an image."""
LEAST_BLUR_PX = 0.4
"""Blur from which on a pixel is small enough beside it to be part of it."""
REACH_BLURS, OTHERS_BLURS, APART_PX = 3.0, 2.0, 2.5
"""How far beyond its rim a disc's pixels are taken, and others' are left out, in blurs; and how far, rim to rim,
others must be from a whole disc that is learned from."""
MOST_MISFIT, LEAST_MISFIT = 4.0, 4e-4
"""A cut disc is taken where its misfit is at most so many times that of whole discs, or (2 %)^2 of the amplitude."""
AMPLITUDE_SIGMAS, LEAST_LOG_AMPLITUDE = 4.0, 0.3
"""And where its amplitude is that of whole discs, to so many of their standard deviations or as the logarithm."""
LEAST_LIGHT = 0.4
"""Share of a whole disc's light from which an image that is not mended is judged by its size; below, by its light."""
SURE, AMBIGUOUS, SAME_PX = 60.0, 12.0, 0.1
"""Chi-square by which a disc cut on the other side must fit worse, its track's prediction counted in, unless its
centre is as near as that: odds of 400. The first: whatever a track expects."""
LEAST_APART = 0.2
"""How far apart two targets' centres are at least, over the radius."""
LEAST_APART_CUT = 1.0
"""And where an edge cuts one of them: of nearer ones it often cuts where they overlap, which is roughly drawn. Of a
walker's 914 images 813 are taken and 11 more than 0.3 px off, with 0.5, 817 and 12, with 2, 700 and 6."""
TWO_BY_TWO = np.array([0, 1, 1, 2, 3, 4, 4, 5])
"""Elements of both covariance matrices of a pair."""
COLUMNS = tuple(name for name in Detections.__dataclass_fields__ if name != "camera")
EXPECTED_PX = 0.1
"""Standard deviation, at least, of an expected centre: of the errors of a track's earlier images."""
SAME_TARGET = 2.0
"""How far from a point a track's prediction may be that is of the same target, in diameters."""
TINY = 1e-12
"""Misfit, at least, of a fit without noise."""
LEAST_RADIUS_SIGMA = 0.01
"""Relative standard deviation of a target's size, at least, that is believed."""


class _Camera:
    """What a camera's whole discs tell."""

    def __init__(self) -> None:
        self.n, self.blur, self.log_size, self.square, self.misfit = 0, 0.75, 0.0, 0.0, LEAST_MISFIT
        self.log_amplitude, self.amplitude_square = 0.0, 0.0

    def learn(self, fit: Array, expected: float) -> None:
        """Take the fit of a whole disc whose radius was ``expected`` [px]."""
        size = math.log(fit[RADIUS] / expected)
        if not (fit[MISFIT] < 0.01 and abs(size) < 0.3 and fit[AMPLITUDE] > 0.0):
            return
        self.n += 1
        gain = 1 / self.n
        self.blur += gain * (fit[BLUR] - self.blur)
        self.misfit += gain * (fit[MISFIT] - self.misfit)
        self.square += gain * (size * size - self.square)
        self.log_size += gain * (size - self.log_size)
        light = math.log(fit[AMPLITUDE])
        self.log_amplitude += gain * (light - self.log_amplitude)
        self.amplitude_square += gain * (light * light - self.amplitude_square)

    def fits(self, misfit: Array, amplitude: Array, limit: float = 0.0) -> Array:
        """Return whether misfits and amplitudes (n,) of fits are as those of whole discs; ``limit``: of misfits."""
        limit = limit or max(MOST_MISFIT * self.misfit, LEAST_MISFIT)
        spread = math.sqrt(max(self.amplitude_square - self.log_amplitude**2, 0.0))
        most = max(AMPLITUDE_SIGMAS * spread, LEAST_LOG_AMPLITUDE)
        usual = np.abs(np.log(np.maximum(amplitude, 1e-9)) - self.log_amplitude) < most
        return np.asarray(usual & (misfit < limit))

    @property
    def size_sigma(self) -> float:
        """Relative standard deviation of the radius about what is expected."""
        return max(math.sqrt(max(self.square - self.log_size**2, 0.0)), LEAST_RADIUS_SIGMA)


class _Tracks(NamedTuple):
    """Where a camera's images of points are expected."""

    xyz: Array
    """(n, 3) the points [m]."""
    distance_m: Array
    """(n,) of the points from the camera."""
    predicted: Predicted
    places: Array
    """(m, 2) images of the predictions [px], infinite where there is none."""
    errors: Array
    """(m,) their standard deviations [px]."""
    distances_m: Array
    """(m,) of the predictions from the camera."""
    reach_m: float
    """How far a prediction of the same target may be."""
    rays: Array
    """(n,) the camera's detections that are of the points."""
    radius: Array
    """(n,) expected of their images [px]."""

    def of(self, which: Array) -> "_Tracks":
        """Return those of some of the points."""
        xyz, distance_m = self.xyz[which], self.distance_m[which]
        return self._replace(xyz=xyz, distance_m=distance_m, rays=self.rays[which], radius=self.radius[which])

    def expected(self, rows: Array) -> tuple[Array, Array]:
        """Return where tracks expect the images (k, 2) of some points, and the standard deviation (k,) [px].

        Infinite where there is no track.
        """
        place, sigma = np.zeros((len(rows), 2)), np.full(len(rows), np.inf)
        if len(self.places):
            away = ((self.xyz[rows, None] - self.predicted.xyz[None]) ** 2).sum(axis=2)
            nearest = away.argmin(axis=1)
            near = away[np.arange(len(rows)), nearest] < self.reach_m**2
            near &= np.isfinite(self.places[nearest, 0])
            place[near], sigma[near] = self.places[nearest[near]], self.errors[nearest[near]]
        return place, sigma

    def two_at(self, ray: int, place: Array, radius: float, otherwise: Array) -> tuple[Array, Array, bool]:
        """Return where tracks expect the two targets (2, 2) of a detection at a ``place``, their radii (2,), True.

        ``radius``: of the detection's first point. Where fewer are expected: ``otherwise``, that radius, False.
        """
        if len(self.places) >= 2:
            away = ((self.places - place) ** 2).sum(axis=1)
            two = np.argpartition(away, 1)[:2]
            if away[two[1]] < (2.5 * radius) ** 2:
                own = self.distance_m[int(np.argmax(self.rays == ray))]
                return self.places[two], radius * own / self.distances_m[two], True
        return otherwise, np.full(2, radius), False


class CutTargets:
    """Fits cut discs, frame set by frame set, and learns from whole ones."""

    def __init__(self) -> None:
        self._cameras: dict[str, _Camera] = {}

    def mended(
        self,
        frame_set: FrameSet,
        detections: Mapping[str, Detections],
        rig: Rig,
        table: RayTable,
        points: Points,
        predicted: Predicted,
        typical_m: float,
    ) -> Mapping[str, Detections] | None:
        """Return the detections with the centres of cut discs; None where there is none to mend.

        ``table``: the rays that were matched to ``points``; ``predicted``: where tracks expect their targets.
        """
        if len(points) == 0 or not typical_m > 0.0:
            return None
        found, changed = dict(detections), False
        at = table.rays, table.start, table.views
        kinds, share, radius, count = kinds_of(points.rays, points.xyz, *at, typical_m)
        many = count.tolist()
        expected: tuple[Array, Array, Array] | None = None
        distances = np.empty((0, 0))
        for c, name in enumerate(rig.names):
            frame = frame_set.frames.get(name)
            image = None if frame is None else frame.image
            if image is None or name not in found:
                continue
            camera, own = self._cameras.setdefault(name, _Camera()), kinds[:, c]
            if camera.n < LEARNED_UP_TO and many[c][WHOLE]:
                whole = np.flatnonzero(own == WHOLE)
                self._learn(camera, image, found[name], points.rays[whole, c], radius[whole, c])
            if camera.n < LEARNED_FROM or camera.blur < LEAST_BLUR_PX:
                continue
            if not any(many[c][kind] for kind in (CUT_ONE, BESIDE, GROWN)):
                continue
            if expected is None:
                focal_px = np.array([max(principal_distances_px(camera.lens)) for camera in rig.cameras])
                each = predicted.xyz, predicted.covariance, table.cameras, table.views
                expected = expected_images(*each, focal_px, EXPECTED_PX)
                distances = np.linalg.norm(points.xyz[:, None] - table.views[None, :, :3], axis=2)
            places, errors, away = expected
            tracks = _Tracks(
                points.xyz, distances[:, c], predicted, places[c], errors[c], away[c], SAME_TARGET * typical_m,
                points.rays[:, c], radius[:, c],
            )  # fmt: skip
            for kind, mend in ((CUT_ONE, _mended), (BESIDE, _mended_beside), (GROWN, _divided)):
                if many[c][kind]:
                    which = np.flatnonzero(own == kind)
                    new = mend(camera, image, found[name], tracks.of(which), share[which, c], tracks)
                    changed |= new is not None
                    found[name] = found[name] if new is None else new
        return found if changed else None

    def _learn(self, camera: _Camera, image: Array, seen: Detections, rows: Array, radius: Array) -> None:
        rows, radius = rows[:AT_ONCE], radius[:AT_ONCE]
        apart = _apart(seen, rows, radius)
        rows, radius = rows[apart], radius[apart]
        patches, there, corner, inside = _patches(
            image, seen, rows[:, None], seen.xy_px[rows], radius, camera.blur, False
        )
        rows, radius = rows[inside], radius[inside]
        if not len(rows):
            return
        start = np.zeros((len(rows), 8))
        start[:, :2] = seen.xy_px[rows] - corner
        start[:, RADIUS], start[:, BLUR] = radius, camera.blur
        fits = fit_discs(patches, there, start, True, np.zeros(len(rows)))
        for fit, expected in zip(fits, radius.tolist(), strict=True):
            if np.isfinite(fit[: BY_RADIUS_X + 2]).all():
                camera.learn(fit, expected)


def _mended(
    camera: _Camera, image: Array, seen: Detections, tracks: _Tracks, share: Array, _: _Tracks
) -> Detections | None:
    """Return a camera's detections with the centres of those of ``tracks`` (n,) that are cut discs; None: none is."""
    rows, radius = tracks.rays, tracks.radius * math.exp(camera.log_size)
    patches, there, corner, inside = _patches(image, seen, rows[:, None], seen.xy_px[rows], radius, camera.blur)
    rows, radius, share = rows[inside], radius[inside], share[inside]
    if not len(rows):
        return None
    start = np.zeros((len(rows), 8))
    start[:, :2] = seen.xy_px[rows] - corner
    start[:, RADIUS], start[:, BLUR] = radius, camera.blur
    start[:, CUT] = radius * cut_of(np.clip(1.0 - share, 0.05, 0.9))
    fits = fit_discs(patches, there, start, False, np.full(len(rows), camera.misfit))
    pixels = there.sum(axis=(1, 2))
    fitted = np.isfinite(fits).all(axis=1)
    fits[~fitted] = 1.0
    good = fitted & camera.fits(fits[:, MISFIT], fits[:, AMPLITUDE])
    good &= (fits[:, CUT] < radius) & (fits[:, CUT] > 0.99 * LEAST_CUT * radius)
    good[good] = _told_apart(fits, pixels, corner, inside, tracks, good)
    good &= np.linalg.norm(fits[:, :2] + corner - seen.xy_px[rows], axis=1) < 1.2 * radius
    light = _share_of_light(camera, patches, there, radius)
    dim = ~good & (light < np.minimum(share, LEAST_LIGHT))
    if dim.any():
        # what is left of a disc looks larger than it is for its blur: its light tells how much is hidden
        diameter = seen.diameter_px.copy()
        diameter[rows[dim]] = 2.0 * radius[dim] * np.sqrt(np.maximum(light[dim], TINY)) / math.exp(camera.log_size)
        seen = replace(seen, diameter_px=diameter)
    rows, fits = rows[good], fits[good]
    if not len(rows):
        return seen if dim.any() else None
    by = camera.size_sigma * radius[good][:, None] * fits[:, BY_RADIUS_X : BY_RADIUS_X + 2]
    covariance = fits[:, [XX, XY, XY, YY]].reshape(-1, 2, 2) + by[:, :, None] * by[:, None, :]
    diameter = 2.0 * radius[good] / math.exp(camera.log_size)
    return _replaced(seen, rows, fits[:, :2] + corner[good], covariance, diameter)


def _share_of_light(camera: _Camera, patches: Array, there: Array, radius: Array) -> Array:
    """Return the light of patches (n, h, h) over that of whole discs (n,); their corners tell the background."""
    off = np.arange(patches.shape[1]) - patches.shape[1] // 2
    corners = off**2 + off[:, None] ** 2 > (patches.shape[1] // 2) ** 2
    background = np.median(patches[:, corners], axis=1)
    light = ((patches - background[:, None, None]) * there).sum(axis=(1, 2))
    return np.asarray(light / (math.exp(camera.log_amplitude) * math.pi * radius**2))


def _told_apart(fits: Array, pixels: Array, corner: Array, inside: Array, tracks: _Tracks, good: Array) -> Array:
    """Return which of the ``good`` fits are told from those cut on the other side; take those that are likelier.

    A sliver of a disc looks the same from either side, its covariance too: where its track expects it decides.
    """
    own, other = fits[good, :2], fits[good, OTHER_X : OTHER_X + 2]
    worse = (pixels[good] - 6) * (fits[good, OTHER_MISFIT] / np.maximum(fits[good, MISFIT], TINY) - 1.0)
    told: Array = (worse > SURE) | (np.linalg.norm(own - other, axis=1) < SAME_PX)
    unsure = np.flatnonzero(~told)
    if len(unsure) == 0:
        return told
    at = np.flatnonzero(good)[unsure]
    expected, sigma = tracks.expected(inside[at])
    expected = expected - corner[at]
    nearer = ((other[unsure] - expected) ** 2 - (own[unsure] - expected) ** 2).sum(axis=1) / sigma**2
    swapped = worse[unsure] + nearer < -AMBIGUOUS
    fits[at[swapped], :2] = other[unsure[swapped]]
    told[unsure] = np.abs(worse[unsure] + nearer) > AMBIGUOUS
    return told


def _divided(
    camera: _Camera, image: Array, seen: Detections, tracks: _Tracks, _: Array, around: _Tracks
) -> Detections | None:
    """Return a camera's detections with two targets for each of those of ``tracks`` that are two; None: none is.

    ``around``: of all points.
    """
    rows, first = np.unique(tracks.rays, return_index=True)
    radius = tracks.radius[first] * math.exp(camera.log_size)
    patches, there, corner, inside = _patches(image, seen, rows[:, None], seen.xy_px[rows], 2.0 * radius, camera.blur)
    rows, radius = rows[inside], radius[inside]
    if not len(rows):
        return None
    start = np.zeros((len(rows), 8))
    start[:, :2] = seen.xy_px[rows] - corner
    start[:, RADIUS], start[:, BLUR] = radius, camera.blur
    fits = fit_pairs(patches, there, start, np.full(len(rows), camera.misfit))
    fitted = np.isfinite(fits).all(axis=1)
    fits[~fitted] = 1.0
    good = fitted & camera.fits(fits[:, PAIR_MISFIT], fits[:, PAIR_AMPLITUDE])
    good &= np.linalg.norm(fits[:, :2] - fits[:, 2:4], axis=1) > LEAST_APART * radius
    xy = fits[:, :4].reshape(-1, 2, 2) + corner[:, None]
    covariance = fits[:, PAIR_COVARIANCE + TWO_BY_TWO].reshape(-1, 2, 2, 2)
    radii = np.stack([radius, radius], axis=1)
    poor = np.flatnonzero(fitted & ~good)
    if len(poor):
        near, light, whole = np.stack([rows[poor], rows[poor]], axis=1), xy[poor], np.zeros(len(poor), bool)
        for k, row in enumerate(poor.tolist()):
            light[k], radii[row], whole[k] = around.two_at(rows[row], seen.xy_px[rows[row]], radius[row], light[k])
        good[poor], xy[poor], covariance[poor] = _cut_pairs(
            camera, image, seen, near, light, whole, radii[poor], around
        )
    if not good.any():
        return None
    near = np.stack([rows[good], len(seen) + np.arange(np.count_nonzero(good))], axis=1)
    return _of_two(camera, seen, near, xy[good], covariance[good], radii[good])


def _mended_beside(
    camera: _Camera, image: Array, seen: Detections, tracks: _Tracks, _: Array, around: _Tracks
) -> Detections | None:
    """Return a camera's detections, those of ``tracks`` that are cut beside others mended; else as ``_divided``."""
    rows, first = np.unique(tracks.rays, return_index=True)
    gap = np.linalg.norm(seen.xy_px[rows, None] - seen.xy_px[None], axis=2)
    gap[np.arange(len(rows)), rows] = np.inf
    gap[:, seen.flags & SATURATED > 0] = np.inf
    partner, radius, size = gap.argmin(axis=1), tracks.radius[first], np.zeros(len(seen))
    size[around.rays[around.rays >= 0]] = around.radius[around.rays >= 0]
    of_partner = np.where(size[partner] > 0.0, size[partner], radius)
    radii = np.stack([radius, of_partner], axis=1) * math.exp(camera.log_size)
    near, alone = np.stack([rows, partner], axis=1), np.ones(len(rows), bool)
    for k in range(len(rows)):
        alone[k] = not np.isin(near[k], near[:k][alone[:k]]).any()
    alone &= gap.min(axis=1) < radii.sum(axis=1) + 2.0 * REACH_BLURS * camera.blur
    near, radii = near[alone], radii[alone]
    light, whole = seen.xy_px[near], np.zeros(len(near), bool)
    good, xy, covariance = _cut_pairs(camera, image, seen, near, light, whole, radii, around)
    return _of_two(camera, seen, near[good], xy[good], covariance[good], radii[good]) if good.any() else None


def _of_two(camera: _Camera, seen: Detections, rows: Array, xy: Array, covariance: Array, radii: Array) -> Detections:
    """Return detections with whole discs in both ``rows`` (n, 2) of each pair; the second ones may be added."""
    radii = np.broadcast_to(radii, rows.shape)
    covariance = covariance + (camera.size_sigma * radii)[..., None, None] ** 2 * np.eye(2)
    diameter = 2.0 * radii / math.exp(camera.log_size)
    return _replaced(
        seen, rows.T.ravel(), xy.swapaxes(0, 1).reshape(-1, 2), covariance.swapaxes(0, 1).reshape(-1, 2, 2),
        diameter.T.ravel(),
    )  # fmt: skip


def _cut_pairs(
    camera: _Camera,
    image: Array,
    seen: Detections,
    near: Array,
    light: Array,
    whole: Array,
    radii: Array,
    tracks: _Tracks,
) -> tuple[Array, Array, Array]:
    """Fit pairs of which one is cut; return which are (n,), their centres (n, 2, 2) and their covariances.

    ``near`` (n, 2): their detections, one twice where they have grown together; ``light`` (n, 2, 2): where their
    light is or, as ``whole`` (n,) says, their centres are expected; ``radii`` (n, 2) [px]; ``tracks``: of all points.
    Which side is cut is told as in ``_told_apart``.
    """
    good, xy, covariance = np.zeros(len(near), bool), light.copy(), np.zeros((len(near), 2, 2, 2))
    reach = 0.5 * np.linalg.norm(light[:, 0] - light[:, 1], axis=1) + radii.max(axis=1, initial=0.0)
    patches, there, corner, inside = _patches(image, seen, near, light.mean(axis=1), reach, camera.blur)
    if not len(inside):
        return good, xy, covariance
    near, light, radii = near[inside], light[inside], radii[inside]
    blur, start = np.full(len(inside), camera.blur), (light - corner[:, None]).reshape(-1, 4)
    given = np.column_stack([start, radii, blur, 1.0 - whole[inside]])
    all_fits = fit_cut_pairs(patches, there, given, np.full(len(inside), camera.misfit))
    of_points, of_tracks = (tracks.xyz, tracks.rays), (tracks.predicted.xyz, tracks.places, tracks.errors)
    limits, counts = (SURE - AMBIGUOUS, AMBIGUOUS, SAME_PX), there.sum(axis=(1, 2))
    best = told_apart(all_fits, counts, corner, near, of_points, of_tracks, tracks.reach_m, limits)
    fits = all_fits[np.arange(len(best)), best]
    known = (best >= 0) & np.isfinite(fits).all(axis=1)
    fits[~known] = 0.0
    centres = fits[:, :4].reshape(-1, 2, 2) + corner[:, None]
    limit = MOST_MISFIT * camera.misfit  # eight unknowns fit much that is no pair
    told = known & camera.fits(fits[:, PAIR_MISFIT], fits[:, PAIR_AMPLITUDE], limit)
    apart = np.hypot(*(centres[:, 0] - centres[:, 1]).T)
    told &= apart > LEAST_APART_CUT * radii.mean(axis=1)
    told &= (np.linalg.norm(centres - light, axis=2) < 1.5 * radii).all(axis=1)
    at = inside[told]
    good[at], xy[at] = True, centres[told]
    covariance[at] = fits[told][:, PAIR_COVARIANCE + TWO_BY_TWO].reshape(-1, 2, 2, 2)
    return good, xy, covariance


def _replaced(seen: Detections, rows: Array, xy: Array, covariance: Array, diameter: Array) -> Detections:
    """Return detections with whole discs in ``rows`` (n,); those beyond the last are added, as the first."""
    more = int(rows.max(initial=0)) + 1 - len(seen)
    at = np.concatenate([np.arange(len(seen)), rows[:more]]) if more > 0 else slice(None)
    columns = {name: getattr(seen, name)[at].copy() for name in COLUMNS}
    columns["xy_px"][rows], columns["covariance_px2"][rows], columns["diameter_px"][rows] = xy, covariance, diameter
    columns["flags"][rows], columns["elongation"][rows], columns["ellipticity"][rows] = 0, 1.0, 0.0
    return replace(seen, **columns)


def cut_of(hidden: Array) -> Array:
    """Return how far from a disc's centre the edge lies that hides a share of it, over the radius; (n,) both."""
    at = np.linspace(1.0, -1.0, 201)
    return np.asarray(np.interp(hidden, (np.arccos(at) - at * np.sqrt(1.0 - at * at)) / math.pi, at))


def _apart(seen: Detections, rows: Array, radius: Array) -> Array:
    """Return which of a camera's detections (k,) no other one is near."""
    gap = np.linalg.norm(seen.xy_px[rows, None] - seen.xy_px[None], axis=2)
    gap -= radius[:, None] + 0.5 * seen.diameter_px[None]
    gap[np.arange(len(rows)), rows] = np.inf
    return np.asarray(gap.min(axis=1, initial=np.inf) > APART_PX)


def _patches(
    image: Array, seen: Detections, rows: Array, place: Array, radius: Array, blur: float, others: bool = True
) -> tuple[Array, Array, Array, Array]:
    """Return patches (m, h, h) about places (n, 2), which of their pixels count, their first pixels, and which.

    Of the places inside the image; ``others``: pixels that other detections than ``rows`` (n, k) light do not count.
    """
    half = math.ceil(float(radius.max(initial=0.0)) + REACH_BLURS * blur) + 1
    middle = np.round(place).astype(int)
    height, width = image.shape
    inside = np.flatnonzero(((middle >= half) & (middle < np.array([width, height]) - half)).all(axis=1))
    corner, side = middle[inside] - half, 2 * half + 1
    patches = np.empty((len(inside), side, side))
    for k, (x, y) in enumerate(corner.tolist()):
        patches[k] = image[y : y + side, x : x + side]
    others_px = 0.5 * seen.diameter_px + OTHERS_BLURS * blur if others else np.full(len(seen), -1.0)
    reach = radius[inside] + REACH_BLURS * blur
    there = own_pixels(side, corner, rows[inside], place[inside], reach, seen.xy_px, others_px)
    return patches, there, corner, inside
