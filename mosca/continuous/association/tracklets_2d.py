"""Image points of one camera followed from frame to frame, and interpolated in between.

A *tracklet* is a point followed in one camera. It is not an identity: it ends where its point is occluded or where
two points merge. It only interpolates the point between two exposures, so that cameras that expose at other instants
can be compared.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from mosca.continuous.association.frame_detections import CameraDetections
from mosca.continuous.association.image_motion import (
    GATE_SIGMA,
    ImageMotion,
    first_motion,
    fixed_motion,
    learned_motion,
)
from mosca.data.arrays import Array
from mosca.data.detections import Detections

LONGEST_GAP = 2.6
"""Longest time from an image point of a tracklet to the next, in the camera's periods."""
PASSES = 3
"""Number of passes that make tracklets, each with the motion learned in the pass before."""


@dataclass
class _Open:
    """Tracklets that may continue (k,): number, last position (k, 2) and its time, mean speed of the last step
    [px/s], the middle of that step, and the change of speed [px/s^2]; NaN after no step, or after only one.
    """

    number: Array
    place: Array
    last_s: Array
    speed: Array
    middle_s: Array
    bend: Array

    @classmethod
    def begun(cls, number: Array, place: Array, now_s: float) -> "_Open":
        k = len(number)
        times = np.full(k, now_s)
        return cls(number, place, times, np.full((k, 2), np.nan), times.copy(), np.full((k, 2), np.nan))

    def only(self, keep: Array) -> "_Open":
        return _Open(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    def plus(self, other: "_Open") -> "_Open":
        names = self.__dataclass_fields__
        return _Open(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))

    def goes_on(self, at: Array, place: Array, now_s: float) -> None:
        """Set the next positions (p, 2) of tracklets ``at`` (p,)."""
        step = np.maximum(now_s - self.last_s[at], 1e-9)[:, None]
        speed, middle = (place - self.place[at]) / step, 0.5 * (now_s + self.last_s[at])
        apart = np.maximum(middle - self.middle_s[at], 1e-9)[:, None]
        self.bend[at] = (speed - self.speed[at]) / apart
        self.place[at], self.last_s[at], self.speed[at], self.middle_s[at] = place, now_s, speed, middle


def tracklets(seen: CameraDetections, longest_gap: float = LONGEST_GAP, learned: bool = True) -> Array:
    """Return the tracklet (n,) of each image point of a camera.

    ``longest_gap``: longest time from an image point of a tracklet to the next, in the camera's periods. The motion
    of image points and the error of its prediction are learned from the tracklets themselves, except for lamps that
    are dark for longer, and where not ``learned`` (``FixedMotion``).
    """
    if longest_gap > LONGEST_GAP or not learned:
        return _followed(seen, fixed_motion(seen), longest_gap)
    motion = first_motion(seen)
    for _pass in range(PASSES):
        of_point = _followed(seen, motion, longest_gap)
        motion = learned_motion(seen, of_point, motion)
    return of_point


def _followed(seen: CameraDetections, motion: ImageMotion, longest_gap: float) -> Array:
    """Return the tracklet (n,) of each image point, linked with the expected ``motion``."""
    of_point = np.full(len(seen.xy_px), -1, dtype=np.int64)
    following = 0
    longest = longest_gap * seen.period_s
    going = _Open.begun(np.empty(0, np.int64), np.empty((0, 2)), 0.0)
    for f, now in enumerate((seen.frame_ns - seen.frame_ns[0]) * 1e-9):
        rows = np.arange(seen.start[f], seen.start[f + 1])
        xy = seen.xy_px[rows]
        going = going.only(now - going.last_s <= longest)
        way, sigma = motion.step(going.speed, going.bend, going.middle_s, going.last_s, now)
        at, to = _pairs(going.place + way, sigma, xy)
        new = np.ones(len(rows), dtype=bool)
        new[to] = False
        of_point[rows[to]] = going.number[at]
        of_point[rows[new]] = following + np.arange(int(new.sum()))
        following += int(new.sum())
        going.goes_on(at, xy[to], now)
        going = going.plus(_Open.begun(of_point[rows[new]], xy[new], now))
    return of_point


def _pairs(place: Array, sigma: Array, xy: Array) -> tuple[Array, Array]:
    """Return pairs of open tracklets, predicted at ``place`` (k, 2) with ``sigma`` (k,) per axis, and image points:
    as many as possible, with the greatest likelihood.
    """
    if not len(place) or not len(xy):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    squared = ((place[:, None] - xy[None]) ** 2).sum(axis=2) / sigma[:, None] ** 2
    allowed = squared < GATE_SIGMA**2
    # the density of a two-dimensional Gaussian: near its place, a tracklet of better known motion is preferred
    cost = squared + 4.0 * np.log(sigma / sigma.min())[:, None]
    at, to = linear_sum_assignment(np.where(allowed, cost, 1e6))
    good = allowed[at, to]
    return at[good], to[good]


@dataclass(frozen=True, eq=False)
class ImageInterpolation:
    """Positions of tracklets at instants: one row per tracklet and instant, sorted by instant.

    ``instant`` (r,): its index; ``tracklet`` (r,); ``xy_px`` (r, 2); ``row`` (r,): the nearer of the two image points
    between which the position lies, ``other`` (r,): the second; ``speed_px`` (r, 2) [px/s]; ``variance_px2`` (r,):
    variance of the interpolation, per axis.
    """

    instant: Array
    tracklet: Array
    xy_px: Array
    row: Array
    other: Array
    speed_px: Array
    variance_px2: Array


@dataclass(frozen=True, eq=False)
class Tracklets:
    """A camera's tracklets as pieces of curves, for interpolation.

    Image points sorted by tracklet and time: ``order`` (n,) their indices, ``tracklet``, ``time_s`` (n,), ``xy_px``
    and ``speed_px`` (n, 2). ``left`` (p,): those from which a piece leads to the next; ``last`` (p,): whether the
    piece is its tracklet's last; ``variance_px2`` (p,): variance per axis of the interpolation in its middle.
    """

    order: Array
    tracklet: Array
    time_s: Array
    xy_px: Array
    speed_px: Array
    left: Array
    last: Array
    variance_px2: Array

    @classmethod
    def of(cls, seen: CameraDetections, tracklet: Array, time_s: Array) -> "Tracklets":
        """Return the paths of tracklets (n,) of image points at ``time_s`` (n,) [s]."""
        order = np.lexsort((time_s, tracklet))
        s, t, xy = tracklet[order], time_s[order], seen.xy_px[order]
        same = (s[1:] == s[:-1]) & (t[1:] - t[:-1] <= LONGEST_GAP * seen.period_s)
        left = np.flatnonzero(same)
        last = np.ones(len(left), dtype=bool)
        last[:-1] = left[1:] != left[:-1] + 1
        return cls(order, s, t, xy, _speeds(s, t, xy), left, last, _variances(s, xy, left))

    def at(self, instants_s: Array) -> ImageInterpolation:
        """Return the positions of the tracklets at ``instants_s`` (rising) [s].

        They are interpolated by cubic Hermite polynomials through neighbouring image points. Nothing is returned
        beyond a tracklet's ends or across gaps of more than LONGEST_GAP periods.
        """
        t, left = self.time_s, self.left
        first = np.searchsorted(instants_s, t[left], "left")
        # an instant at the very end belongs to the last piece
        stop = np.searchsorted(instants_s, t[left + 1], "left")
        stop[self.last] = np.searchsorted(instants_s, t[left[self.last] + 1], "right")
        count = np.maximum(stop - first, 0)
        a = np.repeat(left, count)
        within = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
        instant = np.repeat(first, count) + within
        h = (t[a + 1] - t[a])[:, None]
        u = (instants_s[instant] - t[a])[:, None] / h
        v0, v1, p0, p1 = self.speed_px[a], self.speed_px[a + 1], self.xy_px[a], self.xy_px[a + 1]
        place = (1 + 2 * u) * (1 - u) ** 2 * p0 + u * (1 - u) ** 2 * h * v0
        place = place + u**2 * (3 - 2 * u) * p1 - u**2 * (1 - u) * h * v1
        before = u[:, 0] < 0.5
        sort = np.argsort(instant, kind="stable")
        return ImageInterpolation(
            instant[sort],
            self.tracklet[a][sort],
            place[sort],
            self.order[np.where(before, a, a + 1)][sort],
            self.order[np.where(before, a + 1, a)][sort],
            ((1 - u) * v0 + u * v1)[sort],
            (np.repeat(self.variance_px2, count) * (4 * u * (1 - u))[:, 0] ** 2)[sort],
        )

    @property
    def interpolation_px(self) -> float:
        """Standard deviation per axis [px] of an interpolated position in the middle of a piece, rms of all."""
        return float(np.sqrt(np.mean(self.variance_px2))) if len(self.variance_px2) else 0.0


def _variances(s: Array, xy: Array, left: Array) -> Array:
    """Return the variance per axis [px^2] of an interpolation in the middle of the pieces (p,) from ``left`` on.

    Every image point is interpolated from the first and third neighbours on both sides and, as at the ends of a
    tracklet, without one of the third. The variance is the mean square of these errors near a piece, reduced since
    pieces are half as long: the error by random changes of acceleration grows with the power 2.5 of the length.
    """
    n, k = len(s), np.arange(len(s))

    def at(away: int) -> tuple[Array, Array]:
        other = np.clip(k + away, 0, n - 1)
        return xy[other], (s[other] == s) & (other == k + away)

    (p0, has0), (p1, has1), (p2, has2), (p3, has3) = (at(away) for away in (-3, -1, 1, 3))
    squares, counts = np.zeros(n), np.zeros(n)
    for weights, has in (
        ((-0.0625, 0.5625, 0.5625, -0.0625), has0 & has1 & has2 & has3),
        ((0.0, 0.4375, 0.625, -0.0625), has1 & has2 & has3),
        ((-0.0625, 0.625, 0.4375, 0.0), has0 & has1 & has2),
    ):
        rest = xy - sum(w * p for w, p in zip(weights, (p0, p1, p2, p3), strict=True))
        squares += np.where(has, 0.5 * (rest**2).sum(axis=1), 0.0)
        counts += has
    first, last = np.searchsorted(s, s[left], "left"), np.searchsorted(s, s[left], "right")
    low, high = np.maximum(left - 2, first), np.minimum(left + 4, last)
    sums, number = (np.concatenate([[0.0], np.cumsum(one)]) for one in (squares, counts))
    near = number[high] - number[low]
    usual = squares.sum() / max(counts.sum(), 1.0)
    return np.asarray(np.where(near > 0, (sums[high] - sums[low]) / np.maximum(near, 1.0), usual) / 2.0**5)


def _speeds(s: Array, t: Array, xy: Array) -> Array:
    """Return the image speed (n, 2) at each point: by a parabola through its neighbours, at ends by a line."""
    n = len(t)
    speed = np.zeros((n, 2))
    if n < 2:
        return speed
    h = np.maximum(t[1:] - t[:-1], 1e-9)
    slope = (xy[1:] - xy[:-1]) / h[:, None]
    same = s[1:] == s[:-1]
    has_left, has_right = np.zeros(n, bool), np.zeros(n, bool)
    has_left[1:], has_right[:-1] = same, same
    left, right = np.zeros((n, 2)), np.zeros((n, 2))
    left[1:], right[:-1] = slope, slope
    hl, hr = np.ones(n), np.ones(n)
    hl[1:], hr[:-1] = h, h
    both = has_left & has_right
    share = (hl / (hl + hr))[:, None]
    speed = np.where(both[:, None], share * right + (1 - share) * left, 0.0)
    speed = np.where((has_left & ~has_right)[:, None], left, speed)
    return np.where((has_right & ~has_left)[:, None], right, speed)


def detections_at(seen: CameraDetections, places: ImageInterpolation, instant: int) -> tuple[Detections, Array]:
    """Return the positions of one instant as detections of the camera, and their tracklets."""
    low, high = np.searchsorted(places.instant, [instant, instant + 1])
    rows, others = places.row[low:high], places.other[low:high]
    found = Detections(
        seen.info.name,
        places.xy_px[low:high],
        0.5 * (seen.covariance_px2[rows] + seen.covariance_px2[others])
        + places.variance_px2[low:high, None, None] * np.eye(2),
        0.5 * (seen.diameter_px[rows] + seen.diameter_px[others]),
        np.maximum(seen.peak[rows], seen.peak[others]),
        np.maximum(seen.elongation[rows], seen.elongation[others]),
        seen.flags[rows] | seen.flags[others],
    )
    return found, places.tracklet[low:high]
