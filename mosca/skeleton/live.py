"""A fitted subject followed live among unlabelled tracks: names, pose and joints, frame set by frame set.

Names follow the tracks' numbers. They are checked after each pose: a point too far from its marker loses its name,
and points without a name are assigned to missing markers near the places that the pose predicts. When no pose is
known, or lasting points fit no marker, the tracks of the last half second are named by the distances between the
subject's markers (``naming.searched``). Names that a pose confirms are taken.
"""

from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from mosca.data.arrays import Array
from mosca.data.joint_motion import JointMotion
from mosca.data.rig import Rig
from mosca.data.tracks import STATUSES, Samples
from mosca.labelling.marker_model import MarkerModel
from mosca.skeleton.fit import FittedSubject
from mosca.skeleton.marker_frames import common_shift, usual_covariance
from mosca.skeleton.model import Kinematics
from mosca.skeleton.naming import (
    NAMED,
    RELEASED,
    NamedPoints,
    marker_model_of,
    renamed,
    scale_of,
    searched,
    skin_variance,
    spread_about,
    squared_distances,
)
from mosca.skeleton.pose import PoseSolution
from mosca.skeleton.segment_search import MarkerSegment, segment_points
from mosca.skeleton.track import FEWEST_MARKERS, NO_SHIFT, SkeletonTracker
from mosca.triangulation.camera_shake import without

SEARCH_S = 0.5
"""Length of tracks that is searched for names [s]."""
SEARCHED_FRAMES = 25
"""Frames of that time, evenly spread, that a search reads."""
LOST_S = 0.25
"""A pose that was not confirmed for this time is given up [s]: by then its prediction is worth nothing."""
AGAIN_S = 2.0
"""Time between searches while a pose is known [s]."""
CONFIRMED = 0.6
"""Share of the named points that must fit a pose found by a search."""
BAD = 4.0
"""A pose is wrong whose median squared distance is this many times the stated one."""
UNEXPLAINED = 3
"""So many lasting points without a name, and so many missing markers, start a search: those of a segment."""
ROUNDS = 2
"""Most poses of one frame, as names change."""
STEADY_S = 0.05
"""Time over which the same points must be found as a lost segment's markers [s]."""
LOST_MARKERS = 2
"""A segment with so many missing markers is searched for by its markers' distances."""
GRAVITY = 9.81
"""Least acceleration assumed in a marker's prediction [m/s^2]."""
SHIFT_S = 0.05
"""Time for which the covariance of a person's shift by camera shake is kept [s]. For a person who runs at 8 m/s, 4 m
from the cameras, this variance is off by 0.2 at its end, and a frame takes 1.2 ms; with half it gives 0.1 and 1.3 ms,
with twice 0.4 and 1.2 ms."""
NO_TRACK = -1
MEASURED = STATUSES.index("measured")
LEARNED_S = 0.1
"""Time over which accelerations of segments are averaged [s]."""


@dataclass(frozen=True, eq=False)
class LivePose:
    """Names, pose and joints at one instant.

    ``track`` (n,) numbers of the points and ``label`` (n,) their names, "" for none. ``q`` (nq,) and ``joints`` (one
    instant, with covariances) are None where no pose is known; ``residual_m`` (m,) distance of each marker from the
    model's, NaN where not measured.
    """

    frame: int
    time_ns: int
    track: Array
    label: Array
    q: Array | None = None
    joints: JointMotion | None = None
    residual_m: Array | None = None


class LiveSkeleton:
    """Follows one subject. ``background``: searches run on a thread of their own, and their names come later.

    Use it in a ``with`` block, or call ``close``. ``searches``, ``losses``: their numbers so far. ``rig``: the
    cameras that measure, whose shake is separated from the markers' own errors; None where not known.
    """

    def __init__(self, subject: FittedSubject, background: bool = False, rig: Rig | None = None) -> None:
        self.subject = subject
        self.rig = rig
        self.searches = self.losses = 0
        self._tracker = SkeletonTracker(subject)
        self._m = len(subject.model.labels)
        self._names = np.array([*subject.model.labels, ""])  # of marker -1: ""
        self._skin2 = skin_variance(subject)
        self._model = marker_model_of(subject)
        self._track_of = np.full(self._m, NO_TRACK)
        self._since: dict[int, int] = {}
        self._recent: deque[tuple[int, Samples]] = deque()
        self._path = _Path(self._tracker.kinematics.body_of_marker)
        self._segments = _segments(self._tracker.kinematics, self._skin2)
        self._found: dict[int, tuple[dict[int, int], int]] = {}
        self._shift_ns, self._shift = -_ns(SHIFT_S), (NO_SHIFT[None], NO_SHIFT[None])
        self._known_ns: int | None = None
        self._searched_ns = -_ns(AGAIN_S)
        self._worker = ThreadPoolExecutor(1, "skeleton search") if background else None
        self._search: Future[tuple[dict[int, int], SkeletonTracker]] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """End a search that is still running."""
        if self._worker is not None:
            self._worker.shutdown(cancel_futures=True)

    def step(self, frame: int, time_ns: int, samples: Samples) -> LivePose:
        """Return names and pose at one instant, from those of ``samples`` that were measured in ``frame``."""
        mine = samples.select((samples.frame == frame) & (samples.status == MEASURED))
        mine, shared = self._told_apart(time_ns, mine)
        self._remember(time_ns, mine)
        if self._search is not None and self._search.done():
            self._adopt(*self._search.result(), mine)
            self._search = None
        points, solution = self._followed(time_ns, mine)
        if self._worth_searching(time_ns, mine, points, solution):
            self._searched_ns = time_ns
            self.searches += 1
            given = self._model, self.subject, self._thinned()
            if self._worker is not None:
                self._search = self._worker.submit(_search, *given)
            elif self._adopt(*_search(*given), mine):
                points, solution = self._followed(time_ns, mine)
        if solution is not None:
            points, solution = self._with_lost_segments(time_ns, mine, points, solution)
        self._carry(time_ns, mine, points, solution)
        return self._pose(frame, time_ns, mine, points, solution, shared)

    def _told_apart(self, time_ns: int, mine: Samples) -> tuple[Samples, Array]:
        """Return samples with the covariances of their own errors, and the covariance (3, 3) of a shift of all."""
        mine = replace(mine, covariance=np.nan_to_num(mine.covariance))
        if self.rig is None or not len(mine):
            return mine, NO_SHIFT
        if not 0 <= time_ns - self._shift_ns < _ns(SHIFT_S):
            here = np.isin(mine.track, self._track_of)
            here |= not here.any()
            middle, images = mine.xyz[here].mean(axis=0), mine.n_cameras[here].mean()
            stated = usual_covariance(mine.covariance[None], here[None])
            self._shift_ns, self._shift = time_ns, common_shift(self.rig, middle[None], images[None], stated)
        shared, alike = self._shift
        if not shared.any():
            return mine, NO_SHIFT
        return replace(mine, covariance=without(mine.covariance, alike)), shared[0]

    def _remember(self, time_ns: int, mine: Samples) -> None:
        self._recent.append((time_ns, mine))
        while self._recent[0][0] < time_ns - _ns(SEARCH_S):
            self._recent.popleft()
        self._since = {track: self._since.get(track, time_ns) for track in mine.track.tolist()}

    def _followed(self, time_ns: int, mine: Samples) -> tuple[NamedPoints, PoseSolution | None]:
        """Return names and pose from the names that the tracks have; None for a pose that cannot be trusted."""
        point, marker = np.nonzero(mine.track[:, None] == self._track_of)
        named = np.full(len(mine), -1)
        named[point] = marker
        points = NamedPoints(mine.xyz, mine.covariance, named)
        if self._path.known and len(point) < max(FEWEST_MARKERS, self._path.seen / 2):
            places, spread = self._path.at(time_ns)
            spread = spread + self._skin2[:, None, None] * np.eye(3)
            free = np.setdiff1d(np.arange(self._m), named)
            points = renamed(points, free, places[free], spread[free])
        solution: PoseSolution | None = None
        for k in range(ROUNDS):
            if (points.marker >= 0).sum() < FEWEST_MARKERS:
                return points, None
            solution = self._tracker.step(*points.of_markers(self._m))
            assert solution is not None
            squared = self._squared(points, solution)
            scale = scale_of(squared[points.marker >= 0])
            if scale > BAD:
                return points, None
            if k + 1 == ROUNDS:
                break
            checked = self._checked(points, solution, squared / scale, scale)
            if np.array_equal(checked.marker, points.marker):
                break
            points = checked
        return points, solution

    def _squared(self, points: NamedPoints, solution: PoseSolution) -> Array:
        """Return squared Mahalanobis distances (n,) of the points from their markers, by skin and measurement."""
        squared = np.zeros(len(points.marker))
        rows = np.flatnonzero(points.marker >= 0)
        of = points.marker[rows]
        covariance = self._skin2[of, None, None] * np.eye(3) + points.covariance[rows]
        squared[rows] = squared_distances(solution.residual[of], covariance)
        return squared

    def _checked(self, points: NamedPoints, solution: PoseSolution, squared: Array, scale: float) -> NamedPoints:
        """Return the points with names that do not fit removed and names of missing markers assigned."""
        marker = np.where(squared > RELEASED, -1, points.marker)
        doubtful = squared > NAMED
        sure = marker[~doubtful]
        missing = np.ones(self._m, dtype=bool)
        missing[sure[sure >= 0]] = False
        open_ = np.flatnonzero(missing)
        kept = points._replace(marker=marker)
        if not len(open_) or not ((marker < 0) | doubtful).any():
            return kept
        self._tracker.kinematics.pose(solution.q)
        places = self._tracker.kinematics.markers()[open_]
        return renamed(kept, open_, places, spread_about(solution, self._skin2, open_), doubtful, scale)

    def _with_lost_segments(
        self, time_ns: int, mine: Samples, points: NamedPoints, solution: PoseSolution
    ) -> tuple[NamedPoints, PoseSolution]:
        """Return names and pose with lost segments found by their markers' distances, unchanged for STEADY_S."""
        missing = np.ones(self._m, dtype=bool)
        missing[points.marker[points.marker >= 0]] = False
        found, marker = {}, np.array(points.marker)
        lost = np.bincount(self._tracker.kinematics.body_of_marker[missing], minlength=1) >= LOST_MARKERS
        free = int((marker < 0).sum())
        variance = np.trace(points.covariance, axis1=1, axis2=2) / 3
        for body in np.flatnonzero(lost).tolist() if free >= LOST_MARKERS else ():
            segment = self._segments.get(body)
            if segment is None:
                continue
            here = np.isin(marker, segment.markers)
            rows = np.flatnonzero((marker < 0) | here)
            joint, joint_m2 = self._joint_above(body, solution)
            given = segment_points(segment, joint, joint_m2, points.xyz[rows], variance[rows])
            if given is None:
                continue
            names = dict(zip(given[0].tolist(), mine.track[rows[given[1]]].tolist(), strict=True))
            before, since = self._found.get(body, (names, time_ns))
            found[body] = names, since if before == names else time_ns
            if time_ns - found[body][1] >= _ns(STEADY_S):
                marker[here] = -1
                marker[rows[given[1]]] = given[0]
        self._found = found
        if np.array_equal(marker, points.marker):
            return points, solution
        points = points._replace(marker=marker)
        again = self._tracker.step(*points.of_markers(self._m))
        return points, solution if again is None else again

    def _joint_above(self, body: int, solution: PoseSolution) -> tuple[Array, float]:
        """Return the place (3,) of the joint above a body, and the variance of a coordinate [m^2]."""
        kinematics = self._tracker.kinematics
        kinematics.pose(solution.q)
        place = kinematics.joint_centres()[body - 1]
        slope = kinematics.by_pose(place[None], np.array([kinematics.mj.body_parentid[body]]))
        of = replace(solution, slopes=slope)
        return place, float(np.trace(spread_about(of, np.zeros(1), np.zeros(1, np.int64))[0])) / 3

    def _worth_searching(
        self, time_ns: int, mine: Samples, points: NamedPoints, solution: PoseSolution | None
    ) -> bool:
        whole = time_ns - self._recent[0][0] >= 0.9 * _ns(SEARCH_S)
        if self._search is not None or not whole or len(mine) < FEWEST_MARKERS:
            return False
        if self._known_ns is None:
            return time_ns - self._searched_ns >= _ns(SEARCH_S)
        if solution is None or time_ns - self._searched_ns < _ns(AGAIN_S):
            return False
        before = time_ns - _ns(SEARCH_S / 2)
        lasting = [self._since[track] < before for track in mine.track[points.marker < 0].tolist()]
        return min(sum(lasting), self._m - int((points.marker >= 0).sum())) >= UNEXPLAINED

    def _thinned(self) -> list[Samples]:
        rows = np.unique(np.linspace(0, len(self._recent) - 1, SEARCHED_FRAMES).round().astype(int))
        return [self._recent[k][1] for k in rows.tolist()]

    def _adopt(self, found: Mapping[int, int], tracker: SkeletonTracker, mine: Samples) -> bool:
        """Take names found by a search if a pose confirms them, and more than at present; return whether it does."""
        marker = np.array([found.get(track, -1) for track in mine.track.tolist()], dtype=np.int64)
        points = NamedPoints(mine.xyz, mine.covariance, marker)
        named = int((marker >= 0).sum())
        if named < FEWEST_MARKERS:
            return False
        solution = tracker.step(*points.of_markers(self._m))
        assert solution is not None
        squared = self._squared(points, solution)
        scale = scale_of(squared[marker >= 0])
        fits = (marker >= 0) & (squared < RELEASED * scale)
        now = 0 if self._known_ns is None else int(np.isin(self._track_of, mine.track).sum()) + UNEXPLAINED
        if scale > BAD or fits.sum() < max(FEWEST_MARKERS, CONFIRMED * named, now):
            return False
        self._tracker = tracker
        self._track_of[:] = NO_TRACK
        self._track_of[marker[fits]] = mine.track[fits]
        return True

    def _carry(self, time_ns: int, mine: Samples, points: NamedPoints, solution: PoseSolution | None) -> None:
        """Keep what the next instant needs, and give up a pose that was not found for LOST_S."""
        if solution is not None:
            named = points.marker >= 0
            here = np.isin(self._track_of, mine.track)
            self._track_of[here] = NO_TRACK
            self._track_of[points.marker[named]] = mine.track[named]
            self._tracker.kinematics.pose(solution.q)
            self._path.add(time_ns, self._tracker.kinematics.markers(), points)
            self._known_ns = time_ns
        elif self._known_ns is not None and time_ns - self._known_ns > _ns(LOST_S):
            self._known_ns = None
            self._track_of[:] = NO_TRACK
            self._path.forget()
            self.losses += 1

    def _pose(
        self,
        frame: int,
        time_ns: int,
        mine: Samples,
        points: NamedPoints,
        solution: PoseSolution | None,
        shared: Array,
    ) -> LivePose:
        if solution is None:
            return LivePose(frame, time_ns, mine.track, np.full(len(mine), "", self._names.dtype))
        residual = np.full(self._m, np.nan)
        there = points.marker[points.marker >= 0]
        residual[there] = np.linalg.norm(solution.residual[there], axis=1)
        joints = self._tracker.joints_at(solution, frame, time_ns, shared)
        return LivePose(frame, time_ns, mine.track, self._names[points.marker], solution.q, joints, residual)


class _Path:
    """Places of the markers at the last two instants; prediction by constant velocity and learned accelerations."""

    def __init__(self, body: Array) -> None:
        self.seen = 0
        self._body, self._bodies = body, np.unique(body)
        self.forget()

    def forget(self) -> None:
        """Drop all places and learned accelerations."""
        self._times: list[int] = []
        self._places: list[Array] = []
        self._squared = np.full(len(self._body), GRAVITY**2)

    @property
    def known(self) -> bool:
        """Whether there is a prediction."""
        return len(self._times) == 2

    def at(self, time_ns: int) -> tuple[Array, Array]:
        """Return the markers' places (m, 3) [m] at an instant, and their covariances (m, 3, 3)."""
        (a, b), (before, last) = self._times, self._places
        ahead = 1e-9 * (time_ns - b)
        places = last + (last - before) * (ahead / (1e-9 * (b - a)))
        return places, (self._squared * (ahead**2 / 2) ** 2)[:, None, None] * np.eye(3)

    def add(self, time_ns: int, places: Array, points: NamedPoints) -> None:
        """Add the markers' ``places`` in the pose, and learn the segments' accelerations from them."""
        self.seen = int((points.marker >= 0).sum())
        if self.known and time_ns > self._times[-1]:
            ahead = 1e-9 * (time_ns - self._times[-1])
            off = np.sum((places - self.at(time_ns)[0]) ** 2, axis=1) / 3 / (ahead**2 / 2) ** 2
            share = min(1.0, ahead / LEARNED_S)
            for body in self._bodies:
                rows = self._body == body
                fresh = (1 - share) * self._squared[rows] + share * off[rows].mean()
                self._squared[rows] = np.maximum(fresh, GRAVITY**2)
        self._times = [*self._times, time_ns][-2:]
        self._places = [*self._places, places][-2:]


def _segments(kinematics: Kinematics, skin2: Array) -> dict[int, MarkerSegment]:
    """Return body -> its markers, of bodies below the root that have two or more."""
    found = {}
    for body in range(2, kinematics.mj.nbody):
        rows = np.flatnonzero(kinematics.body_of_marker == body)
        if len(rows) >= LOST_MARKERS:
            found[body] = MarkerSegment(rows, kinematics.local[rows], skin2[rows])
    return found


def _search(
    model: MarkerModel, subject: FittedSubject, samples: list[Samples]
) -> tuple[dict[int, int], SkeletonTracker]:
    return searched(model, subject.model.labels, samples), SkeletonTracker(subject)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
