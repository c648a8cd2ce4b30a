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

from mosca.camera.projection import project
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.data.rays import Predicted, RayTable
from mosca.data.rig import Camera, Rig, principal_distances_px
from mosca.data.tracks import Points
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
from mosca.detection.cut_targets.kinds import CUT as CUT_ONE
from mosca.detection.cut_targets.kinds import GROWN, WHOLE, kinds_of, own_pixels
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

    def usual(self, amplitude: Array) -> Array:
        """Return whether amplitudes (n,) are as those of whole discs."""
        spread = math.sqrt(max(self.amplitude_square - self.log_amplitude**2, 0.0))
        most = max(AMPLITUDE_SIGMAS * spread, LEAST_LOG_AMPLITUDE)
        return np.asarray(np.abs(np.log(np.maximum(amplitude, 1e-9)) - self.log_amplitude) < most)

    @property
    def size_sigma(self) -> float:
        """Relative standard deviation of the radius about what is expected."""
        return max(math.sqrt(max(self.square - self.log_size**2, 0.0)), LEAST_RADIUS_SIGMA)


class _Tracks(NamedTuple):
    """Where a camera's images of points are expected."""

    camera: Camera
    xyz: Array
    """(n, 3) the points [m]."""
    predicted: Predicted
    reach_m: float
    """How far a prediction of the same target may be."""

    def expected(self, rows: Array) -> tuple[Array, Array]:
        """Return where tracks expect the images (k, 2) of some points, and the standard deviation (k,) [px].

        Infinite where there is no track.
        """
        xyz, predicted = self.xyz[rows], self.predicted
        place, sigma = np.zeros((len(xyz), 2)), np.full(len(xyz), np.inf)
        if not len(predicted.xyz):
            return place, sigma
        away = np.linalg.norm(xyz[:, None] - predicted.xyz[None], axis=2)
        nearest = away.argmin(axis=1)
        near = away.min(axis=1) < self.reach_m
        there = predicted.xyz[nearest[near]]
        sigma_m = np.sqrt(np.trace(predicted.covariance[nearest[near]], axis1=1, axis2=2))
        depth = np.linalg.norm(there - self.camera.world_from_camera.translation, axis=1)
        place[near] = np.nan_to_num(project(self.camera, there))
        sigma[near] = np.hypot(sigma_m / depth * max(principal_distances_px(self.camera.lens)), EXPECTED_PX)
        return place, sigma


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
        kinds, share, radius = kinds_of(points.rays, points.xyz, *at, typical_m)
        for c, name in enumerate(rig.names):
            frame = frame_set.frames.get(name)
            image = None if frame is None else frame.image
            if image is None or name not in found:
                continue
            camera, own = self._cameras.setdefault(name, _Camera()), kinds[:, c]
            if camera.n < LEARNED_UP_TO:
                whole = np.flatnonzero(own == WHOLE)
                self._learn(camera, image, found[name], points.rays[whole, c], radius[whole, c])
            if camera.n < LEARNED_FROM or camera.blur < LEAST_BLUR_PX:
                continue
            cut, grown = np.flatnonzero(own == CUT_ONE), np.flatnonzero(own == GROWN)
            if len(cut):
                tracks = _Tracks(rig.cameras[c], points.xyz[cut], predicted, SAME_TARGET * typical_m)
                rows = points.rays[cut, c]
                new = _mended(camera, image, found[name], rows, radius[cut, c], share[cut, c], tracks)
                changed |= new is not None
                found[name] = found[name] if new is None else new
            if len(grown):
                rows, first = np.unique(points.rays[grown, c], return_index=True)
                new = _divided(camera, image, found[name], rows, radius[grown[first], c])
                changed |= new is not None
                found[name] = found[name] if new is None else new
        return found if changed else None

    def _learn(self, camera: _Camera, image: Array, seen: Detections, rows: Array, radius: Array) -> None:
        rows, radius = rows[:AT_ONCE], radius[:AT_ONCE]
        apart = _apart(seen, rows, radius)
        rows, radius = rows[apart], radius[apart]
        patches, there, corner, inside = _patches(image, seen, rows, radius, camera.blur, False)
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
    camera: _Camera, image: Array, seen: Detections, rows: Array, radius: Array, share: Array, tracks: _Tracks
) -> Detections | None:
    """Return a camera's detections with the centres of those ``rows`` that are cut discs; None where none is.

    ``tracks``: of the points that the ``rows`` (n,) belong to.
    """
    radius = radius * math.exp(camera.log_size)
    patches, there, corner, inside = _patches(image, seen, rows, radius, camera.blur)
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
    limit = max(MOST_MISFIT * camera.misfit, LEAST_MISFIT)
    good = fitted & (fits[:, MISFIT] < limit) & (fits[:, CUT] < radius) & (fits[:, CUT] > 0.99 * LEAST_CUT * radius)
    good &= camera.usual(fits[:, AMPLITUDE])
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


def _divided(camera: _Camera, image: Array, seen: Detections, rows: Array, radius: Array) -> Detections | None:
    """Return a camera's detections with two targets for each of those ``rows`` that are two; None where none is."""
    radius = radius * math.exp(camera.log_size)
    patches, there, corner, inside = _patches(image, seen, rows, 2.0 * radius, camera.blur)
    rows, radius = rows[inside], radius[inside]
    if not len(rows):
        return None
    start = np.zeros((len(rows), 8))
    start[:, :2] = seen.xy_px[rows] - corner
    start[:, RADIUS], start[:, BLUR] = radius, camera.blur
    fits = fit_pairs(patches, there, start, np.full(len(rows), camera.misfit))
    good = fits[:, PAIR_MISFIT] < max(MOST_MISFIT * camera.misfit, LEAST_MISFIT)
    if not good.any():
        return None
    good &= np.isfinite(fits).all(axis=1)
    fits[~good] = 1.0
    good &= camera.usual(fits[:, PAIR_AMPLITUDE])
    good &= np.linalg.norm(fits[:, :2] - fits[:, 2:4], axis=1) > LEAST_APART * radius
    rows, fits, radius, corner = rows[good], fits[good], radius[good], corner[good]
    if not len(rows):
        return None
    variance = (camera.size_sigma * radius)[:, None, None] ** 2 * np.eye(2)
    both = [
        (fits[:, 2 * k : 2 * k + 2] + corner, fits[:, PAIR_COVARIANCE + 3 * k + np.array([0, 1, 1, 2])])
        for k in range(2)
    ]
    diameter = 2.0 * radius / math.exp(camera.log_size)
    return _replaced(
        seen,
        np.concatenate([rows, len(seen) + np.arange(len(rows))]),
        np.concatenate([xy for xy, _ in both]),
        np.concatenate([s.reshape(-1, 2, 2) + variance for _, s in both]),
        np.concatenate([diameter, diameter]),
    )


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
    image: Array, seen: Detections, rows: Array, radius: Array, blur: float, others: bool = True
) -> tuple[Array, Array, Array, Array]:
    """Return patches (n, h, h) about detections, which of their pixels count, their first pixels (n, 2), and which.

    Of those of the ``rows`` that are inside the image; ``others``: pixels that other detections light do not count.
    """
    half = math.ceil(float(radius.max(initial=0.0)) + REACH_BLURS * blur) + 1
    middle = np.round(seen.xy_px[rows]).astype(int)
    height, width = image.shape
    inside = np.flatnonzero(((middle >= half) & (middle < np.array([width, height]) - half)).all(axis=1))
    corner, side = middle[inside] - half, 2 * half + 1
    patches = np.empty((len(inside), side, side))
    for k, (x, y) in enumerate(corner.tolist()):
        patches[k] = image[y : y + side, x : x + side]
    others_px = 0.5 * seen.diameter_px + OTHERS_BLURS * blur if others else np.full(len(seen), -1.0)
    reach = radius[inside] + REACH_BLURS * blur
    return patches, own_pixels(side, corner, rows[inside], reach, seen.xy_px, others_px), corner, inside
