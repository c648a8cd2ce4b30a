"""Coarse synchronisation, good enough for matching, of cameras started at unknown times, from what they saw.

Rays of two cameras to one point lie in a plane with the line between the cameras (epipolar constraint), if and only
if they are of one instant. So one camera's clock is shifted against the other's until most rays find a partner in
their plane, in every part of the recording; chance partners are equally frequent at any shift. The shift is found
over the whole recording first, then in windows along it. A straight line through these gives offset and drift, which
are refined with curves (``estimate``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mosca.camera.projection import lens_directions
from mosca.continuous.association.frame_detections import CameraDetections
from mosca.continuous.association.tracklets_2d import ImageInterpolation, Tracklets
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Rig, principal_distances_px
from mosca.errors import InputError

COARSE_PX, FINE_PX = 1.5, 0.4
"""Distance [px] from the epipolar line at which a partner counts exp(-1/2), in first search and windows."""
INSTANTS = 60
"""Number of instants of a search at which rays are compared."""
MOST_POINTS = 40
"""Most points of an instant that are compared, of the camera whose clock is held fixed."""
CLEAR = 8.0
"""Peak height of the best shift above the others, in their (robust) standard deviations, from which on it is accepted
in spite of a rival."""
CHANCE = 1e-3
"""Largest chance that the best of all shifts fits as well although none is right."""
RANKED = 100
"""Fewest steps to both sides that are compared, even if fewer are searched: among few no rank is improbable."""
RIVAL = 0.85
"""A second peak of at least this fraction of the best makes the shift ambiguous, as for periodic motion (gait)."""
WINDOWS = 8
"""Number of parts of a recording that are ranked, and synchronised, separately."""
DRIFT_FROM_S = 4.0
"""Shortest recording for which a drift is estimated [s]: shorter ones do not determine a drift that matters."""
WIDEST_DRIFT = 400e-6
"""Largest drift between two cameras' clocks that is searched for."""


@dataclass(frozen=True)
class ClockTie:
    """Map of a camera's clock to the common one: ``offset_s + (1 + drift) (stamp_ns - origin_ns) / 1e9``.

    ``clear``: peak height of the shift in its search (inf where it was not searched for). ``rival_s``: another offset
    that fits about as well, None if there is none.
    """

    origin_ns: int
    offset_s: float = 0.0
    drift: float = 0.0
    clear: float = np.inf
    rival_s: float | None = None

    def common_s(self, own_s: Array) -> Array:
        """Return instants on the common clock [s] for instants on the camera's own clock, from ``origin_ns`` [s]."""
        return self.offset_s + (1.0 + self.drift) * own_s


def common_clock(seen: Sequence[CameraDetections]) -> tuple[ClockTie, ...]:
    """Return the clock ties of cameras whose stamps are of one clock."""
    origin = min(int(one.frame_ns[0]) for one in seen)
    return tuple(ClockTie(origin) for _one in seen)


def tied_clocks(
    seen: Sequence[CameraDetections], tracklet: Sequence[Array], rig: Rig, search_s: float
) -> tuple[ClockTie, ...]:
    """Return the clock maps of cameras with independent clocks; the first camera's is the common one.

    ``search_s``: largest difference of the cameras' start times. InputError where the images do not determine it.
    """
    own_s = [one.time_s(int(one.frame_ns[0])) for one in seen]
    paths = [Tracklets.of(one, tracklet[c], own_s[c]) for c, one in enumerate(seen)]
    ties: dict[int, ClockTie] = {0: ClockTie(int(seen[0].frame_ns[0]))}
    waiting: dict[int, ClockTie | None] = dict.fromkeys(range(1, len(seen)))
    newest = 0
    while waiting:
        held = Tracklets.of(seen[newest], tracklet[newest], ties[newest].common_s(own_s[newest]))
        for c, so_far in waiting.items():
            if so_far is None or so_far.clear < 3 * CLEAR:
                period_s = max(seen[newest].period_s, seen[c].period_s)
                pair = _Pair(rig.cameras[newest], rig.cameras[c], period_s, held, paths[c])
                found = _searched(pair, search_s, int(seen[c].frame_ns[0]))
                if found is not None and (so_far is None or found.clear > so_far.clear):
                    waiting[c] = found
        told = {c: tie for c, tie in waiting.items() if tie is not None}
        if not told:
            named = ", ".join(f"'{seen[c].info.name}'" for c in waiting)
            raise InputError(
                f"camera {named}: no time offset within {search_s:g} s makes its images meet those of "
                "another camera; check the rig's poses and that both film the same moving points, or give a "
                "wider --search if they were started farther apart"
            )
        newest = max(told, key=lambda c: told[c].clear)
        ties[newest] = told[newest]
        del waiting[newest]
    return tuple(ties[c] for c in range(len(seen)))


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two cameras with their image points: the clock of a is held fixed, the clock of b is searched."""

    camera_a: Camera
    camera_b: Camera
    period_s: float
    """The longer of their frame periods."""
    path_a: Tracklets
    path_b: Tracklets

    @property
    def px_per_rad(self) -> float:
        return float(np.mean(principal_distances_px(self.camera_b.lens)))

    @property
    def fine_px(self) -> float:
        """Distance [px] from the epipolar line at which a partner counts exp(-1/2) in the windows: the error of
        positions between exposures, at least FINE_PX.
        """
        return max(float(np.hypot(self.path_a.interpolation_px, self.path_b.interpolation_px)), FINE_PX)

    def speed_px(self) -> float:
        """Return the upper quartile of the speed of image points in the camera searched [px/s]."""
        some = self.path_b.at(_inner(float(self.path_b.time_s.min()), float(self.path_b.time_s.max())))
        if not len(some.row):
            return 0.0
        return float(np.quantile(np.linalg.norm(some.speed_px, axis=1), 0.75))


def _searched(pair: _Pair, search_s: float, origin_ns: int) -> ClockTie | None:
    """Return the tie of b's clock, counted from ``origin_ns``, to a's; None: unclear."""
    speed = pair.speed_px()
    if speed <= 0.0:
        return None
    step = float(np.clip(COARSE_PX / speed, 0.1 * pair.period_s, 2.0 * pair.period_s))
    most = int(np.ceil(search_s / step))
    shifts = step * np.arange(-max(most, RANKED), max(most, RANKED) + 1)
    # compare where both may have been running
    begin_a, end_a = float(pair.path_a.time_s.min()), float(pair.path_a.time_s.max())
    parts = np.array_split(_instants(pair.path_a, begin_a, end_a), WINDOWS)
    each = [_votes(pair, instants, shifts, COARSE_PX) for instants in parts]
    votes, count = (np.array(one) for one in zip(*each, strict=True))
    asked = count.sum(axis=0)
    enough = asked >= 0.25 * asked.max()
    score = np.where(enough, votes.sum(axis=0) / np.maximum(asked, 1), 0.0)
    some = score[enough]
    middle = float(np.median(some))
    spread = 1.4826 * float(np.median(np.abs(some - middle))) + 1e-6
    tried = enough & (np.abs(shifts) <= search_s + step)
    chance = np.where(tried, log_chances(votes, count) + np.log(max(tried.sum(), 1)), 0.0)
    height = score - middle
    if chance.min() > np.log(CHANCE):
        return None
    begin, end = _extent(height, int(np.argmin(chance)))
    at = begin + int(np.argmax(height[begin:end]))
    clear = float(height[at]) / max(spread, 0.005)
    if height[at] < 0.1:
        return None
    # a shift that chance explains is no rival
    other = rival(np.where(chance < np.log(CHANCE), height, np.minimum(height, 0.5 * height[at])), at)
    if clear < CLEAR and other is not None:
        return None
    # b's clock = shift + (1 + drift) a's: inverted
    shift, drift = _line(pair, float(shifts[at]), step, speed)
    rate = 1 / (1 + drift)
    return ClockTie(
        origin_ns, -shift * rate, rate - 1, clear, None if other is None else -float(shifts[other]) * rate
    )


def log_chances(votes: Array, count: Array) -> Array:
    """Return for each shift (n,) the logarithm of the chance that a wrong shift fits as well in all parts.

    ``votes``, ``count`` (parts, n) as of ``_votes``. Rays that meet by chance do so for as long as points move alike;
    this time depends on motion, number of points and overlap. So the shifts are ranked in each part of the recording,
    without an assumption on the scores' distribution, and the parts are combined (Fisher 1932). The right shift is
    among the best in every part; a chance fit lasts for one or two parts.
    """
    from scipy.stats import chi2, rankdata  # takes a second to import

    ran = count >= np.maximum(0.5 * count.max(axis=1, keepdims=True), 1)
    total = np.zeros(votes.shape[1])
    for own, vote, of in zip(ran, votes, count, strict=True):
        if own.any():
            total[own] -= np.log(rankdata(-vote[own] / of[own], method="max") / own.sum())
    parts = ran.sum(axis=0)
    return np.where(parts > 0, chi2.logsf(2.0 * total, 2 * np.maximum(parts, 1)), 0.0)


def rival(score: Array, best: int) -> int | None:
    """Return the index of another maximum that is about as high as the ``best``, None where there is none.

    ``score`` (n,): height above the chance level; the best peak extends down to half its height on both sides.
    """
    begin, end = _extent(score, best)
    others = score.copy()
    others[begin:end] = -np.inf
    second = int(np.argmax(others))
    return second if others[second] >= RIVAL * score[best] else None


def _extent(score: Array, top: int) -> tuple[int, int]:
    """Return begin and end of the indices about ``top`` whose score is at least half as high."""
    low = np.flatnonzero(score < 0.5 * score[top])
    return int(low[low < top].max(initial=-1)) + 1, int(low[low > top].min(initial=len(score)))


def _line(pair: _Pair, shift: float, step: float, speed: float) -> tuple[float, float]:
    """Return shift and drift from windows along the recording."""
    low = max(float(pair.path_a.time_s.min()), float(pair.path_b.time_s.min()) - shift)
    high = min(float(pair.path_a.time_s.max()), float(pair.path_b.time_s.max()) - shift)
    length = high - low
    windows = WINDOWS if length >= DRIFT_FROM_S else 1
    fine = min(pair.fine_px / speed, 0.25 * step)
    edges = np.linspace(low, high, windows + 1)
    found = []
    for a, b in pairwise(edges):
        reach = 2.0 * step + WIDEST_DRIFT * length
        near = shift + np.arange(-reach, reach + fine, fine)
        votes, count = _votes(pair, _instants(pair.path_a, a, b), near, pair.fine_px)
        score = votes / np.maximum(count, 1)
        if count.max() == 0:
            continue
        found.append((0.5 * (a + b), _top(near, score), float(score.max())))
    t, s, worth = np.array(found).T
    if windows == 1 or len(t) < 3:
        return float(np.median(s)), 0.0
    return _straight(t, s, worth)


def _straight(t: Array, s: Array, worth: Array) -> tuple[float, float]:
    """Return offset and slope of a line through points; outliers get little weight (Cauchy)."""
    weight, scale = worth.copy(), 0.0
    middle, slope = 0.0, 0.0
    for _step in range(20):
        root = np.sqrt(weight)
        design = np.column_stack([np.ones_like(t), t])
        (middle, slope), *_rest = np.linalg.lstsq(design * root[:, None], s * root, rcond=None)
        off = np.abs(s - middle - slope * t)
        scale = max(1.4826 * float(np.median(off)), 1e-7)
        weight = worth / (1 + (off / (2 * scale)) ** 2)
    return float(middle), float(slope)


def _top(shifts: Array, score: Array) -> float:
    """Return the shift of the highest score, interpolated between the steps by a parabola."""
    at = int(np.argmax(score))
    if at in (0, len(score) - 1):
        return float(shifts[at])
    a, b, c = score[at - 1 : at + 2]
    bend = a - 2 * b + c
    return float(shifts[at] + (shifts[1] - shifts[0]) * (0.5 * (a - c) / bend if bend < 0 else 0.0))


def _votes(pair: _Pair, instants_a: Array, shifts: Array, width_px: float) -> tuple[Array, Array]:
    """Return for each shift the rays of a that have a partner in b, weighted by nearness, and the rays tested."""
    instant_of, directions = _world_rays(pair.camera_a, pair.path_a.at(instants_a))
    base = pair.camera_b.world_from_camera.translation - pair.camera_a.world_from_camera.translation
    base = base / np.linalg.norm(base)
    votes, asked = np.zeros(len(shifts)), np.zeros(len(shifts))
    random = np.random.default_rng(0)
    for k, instant in enumerate(instants_a):
        mine = directions[instant_of == k]
        if not len(mine):
            continue
        if len(mine) > MOST_POINTS:
            mine = mine[random.choice(len(mine), MOST_POINTS, replace=False)]
        normal = np.cross(mine, base)
        length = np.linalg.norm(normal, axis=1)
        normal = normal[length > 0.05] / length[length > 0.05][:, None]
        theirs, rays = _world_rays(pair.camera_b, pair.path_b.at(instant + shifts))
        if not len(theirs) or not len(normal):
            continue
        off = np.abs(rays.astype(np.float32) @ normal.T.astype(np.float32)) * np.float32(pair.px_per_rad)
        starts = np.flatnonzero(np.diff(theirs, prepend=-1))
        nearest = np.minimum.reduceat(off, starts, axis=0)
        at = theirs[starts]
        votes[at] += np.exp(-0.5 * (nearest / width_px) ** 2).sum(axis=1)
        asked[at] += len(normal)
    return votes, asked


def _world_rays(camera: Camera, places: ImageInterpolation) -> tuple[Array, Array]:
    """Return the rising instants (r,) of image points and their unit rays (r, 3) in the world."""
    directions = lens_directions(camera.lens, places.xy_px) @ camera.world_from_camera.rotation.T
    known = np.isfinite(directions).all(axis=1)
    return places.instant[known], directions[known]


def _instants(path: Tracklets, begin_s: float, end_s: float) -> Array:
    """Return the instants of a comparison within a span.

    They are exposures of the camera with the fixed clock where its interpolated positions are less accurate than the
    votes are wide. Else they are evenly spaced: at exposures of equal rates all positions of the other camera would
    be interpolated at one phase, with a common error.
    """
    if path.interpolation_px <= COARSE_PX:
        return _inner(begin_s, end_s)
    times = np.unique(path.time_s[(path.time_s >= begin_s) & (path.time_s <= end_s)])
    return times[np.unique(np.linspace(0, len(times) - 1, INSTANTS).round().astype(int))] if len(times) else times


def _inner(begin_s: float, end_s: float) -> Array:
    """Return the instants of a search, evenly spaced within a span."""
    return np.linspace(begin_s, end_s, INSTANTS + 2)[1:-1]
