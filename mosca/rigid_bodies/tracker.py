"""Rigid bodies from marker constellations: 6-DOF poses with covariance, followed, lost and found again.

``BodyTracker`` follows bodies from instant to instant (live). A marker is assigned the track that it had before, else
the point nearest to the position that the body's motion predicts. A point that disagrees with the others is left out.
Ambiguous poses are withheld (``mosca.rigid_bodies.pose``). A lost body is searched for among all free points.
``body_poses`` does the same over whole tracks (offline): forwards, and then backwards for frames without a
pose.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses, RigidBody, joined_poses
from mosca.data.rotations import quaternion_from_rotation
from mosca.data.tracks import Points, Samples, Tracks
from mosca.rigid_bodies.ambiguity import check_bodies
from mosca.rigid_bodies.pose import (
    BodyPoseFit,
    BodySettings,
    Constellation,
    InstantPoints,
    angle_between,
    instant_points,
    predicted,
    rotation_sigma,
    vector_of,
)

DEFAULTS = BodySettings()
FRESH = 0.5
"""Weight of the newest step in the body's velocity."""
FLIPPED_RAD = 0.5
"""A pose whose rotation is farther than this from its prediction [rad] cannot be disambiguated by the prediction."""


@dataclass(eq=False)
class _State:
    """State of a body: its last pose, its motion, and the last tracks of its markers (m,), -1 for none."""

    track: Array
    rotation: Array
    translation: Array
    rates: Array
    time_s: float = -np.inf
    moving: bool = False


@dataclass(frozen=True, eq=False)
class _Answer:
    """Result for one body at one instant: its pose, or, where that is withheld, the number of markers seen."""

    fit: BodyPoseFit | None
    count: int


class BodyTracker:
    """Tracks rigid bodies. Stateful: pass points in order of time.

    Raises InputError for bodies that are ambiguous under rotation or with each other.
    """

    def __init__(self, bodies: Sequence[RigidBody], settings: BodySettings = DEFAULTS) -> None:
        check_bodies(bodies, settings.alike_m)
        self.bodies, self.settings = tuple(bodies), settings
        self._constellations = [Constellation(body, settings) for body in bodies]
        self._states = [
            _State(np.full(len(body.markers), -1), np.eye(3), np.zeros(3), np.zeros(6)) for body in bodies
        ]

    def update(self, points: Points | Samples | Tracks, frame: int, time_ns: int) -> BodyPoses:
        """Return the poses of all bodies with visible markers at one instant.

        ``points``: triangulated points, or the tracker's samples. Samples of other frames and samples that are not
        measured are left out. Labels of markers, where present, are used unless they contradict the geometry.
        """
        seen = _of_instant(points, frame)
        answers = self.attend(seen, time_ns * 1e-9)
        return _poses(self.bodies, answers, seen, frame, time_ns)

    def attend(self, seen: InstantPoints, time_s: float) -> list[_Answer]:
        """Return each body's answer at ``time_s`` [s]."""
        free = np.ones(len(seen), dtype=bool)
        answers: list[_Answer] = []
        for constellation, state in zip(self._constellations, self._states, strict=True):
            answer = self._followed(constellation, state, seen, free, time_s)
            answers.append(answer)
            if answer.fit is not None:
                free[answer.fit.rows[answer.fit.rows >= 0]] = False
        lost = [k for k, answer in enumerate(answers) if answer.fit is None]
        for k, answer in self._found(lost, seen, free):
            answers[k] = _Answer(answer.fit, max(answer.count, answers[k].count))
        for answer, state in zip(answers, self._states, strict=True):
            if answer.fit is not None:
                _remember(state, answer.fit, seen, time_s, self.settings)
        return answers

    def _followed(
        self, one: Constellation, state: _State, seen: InstantPoints, free: Array, time_s: float
    ) -> _Answer:
        """Return the pose of a body whose markers are identified by label, by track or by the body's motion."""
        rows = _named(one.body, seen)
        named = int((rows >= 0).sum()) >= 3
        step = time_s - state.time_s
        recent = 0.0 <= step <= self.settings.coast_s
        rows = _by_track(state.track, seen, rows)
        if recent:
            rotation, translation = predicted(state.rotation, state.translation, state.rates, step)
            if (rows >= 0).sum() < 3:
                reach, distances = self._reach(one, state, step), one.body.distances()
                if reach < distances[distances > 0].min() / 2:
                    rows = one.claim(seen, free, rotation, translation, rows, reach)
        count = int((rows >= 0).sum())
        fit = one.sound_fit(seen, rows)
        if fit is None:
            return _Answer(None, count)
        fit = self._completed(one, seen, free, fit)
        others = [] if named else one.others(fit, seen)
        near = (
            recent
            and angle_between(fit.rotation, rotation) < FLIPPED_RAD
            and all(angle_between(o.rotation, rotation) > 3 * FLIPPED_RAD for o in others)
        )
        few = recent and not named and fit.count < min(self.settings.least_found, len(one.body.markers))
        if (others and not near) or (few and not near) or not one.settled(fit):
            return _Answer(None, fit.count)
        return _Answer(fit, fit.count)

    def _completed(self, one: Constellation, seen: InstantPoints, free: Array, fit: BodyPoseFit) -> BodyPoseFit:
        """Return the pose refitted with free points at the predicted positions of the markers without a point."""
        reach = one.span_m * rotation_sigma(fit)
        rows = one.claim(seen, free, fit.rotation, fit.translation, fit.rows, reach)
        more = one.sound_fit(seen, rows) if (rows != fit.rows).any() else None
        return more if more is not None and more.count > fit.count else fit

    def _reach(self, one: Constellation, state: _State, step_s: float) -> float:
        """Return how far a marker can stray from its prediction in ``step_s`` [m]."""
        strength = self.settings.acceleration_mps2 + self.settings.turn_rad_s2 * one.span_m
        start = 0.0 if state.moving else self.settings.speed_mps * step_s
        return start + strength * step_s**2 / 2

    def _found(self, lost: list[int], seen: InstantPoints, free: Array) -> Iterator[tuple[int, _Answer]]:
        """Search for lost bodies among the free points; the body that explains most points claims them first."""
        while lost and free.sum() >= 3:
            fits = {}
            for k in lost:
                fit, count = self._constellations[k].find(seen, free)
                if fit is not None and self._constellations[k].settled(fit):
                    fits[k] = fit
                elif count:
                    yield k, _Answer(None, count)
            if not fits:
                return
            best = max(fits, key=lambda k: (fits[k].count, -fits[k].chi2.sum()))
            rivals = [
                k
                for k, fit in fits.items()
                if k != best
                and np.intersect1d(fit.rows[fit.rows >= 0], fits[best].rows).size
                and fit.count == fits[best].count
                and fit.chi2.sum() - fits[best].chi2.sum() < self.settings.flip_chi2
            ]
            for k in [best, *rivals]:
                yield k, _Answer(None if rivals else fits[k], fits[k].count)
            free[fits[best].rows[fits[best].rows >= 0]] = False
            lost = [k for k in fits if k not in (best, *rivals)]


def body_poses(tracks: Tracks, bodies: Sequence[RigidBody], settings: BodySettings = DEFAULTS) -> BodyPoses:
    """Return the poses of ``bodies`` in every frame of ``tracks``, labelled or not.

    Only measured samples are used. Raises InputError for ambiguous bodies.
    """
    return _over_tracks(tracks, bodies, settings)[0]


def labelled_by_bodies(tracks: Tracks, bodies: Sequence[RigidBody], settings: BodySettings = DEFAULTS) -> Tracks:
    """Return ``tracks`` with the markers' names as labels of samples that a pose uses; other labels stay."""
    return _over_tracks(tracks, bodies, settings)[1]


def _over_tracks(tracks: Tracks, bodies: Sequence[RigidBody], settings: BodySettings) -> tuple[BodyPoses, Tracks]:
    measured = np.flatnonzero(tracks.status == "measured")
    frames, first = np.unique(tracks.frame[measured], return_index=True)
    groups = np.split(measured, first[1:])
    instants = [instant_points(tracks.xyz[g], tracks.covariance[g], tracks.track[g], tracks.label[g]) for g in groups]
    times = [int(tracks.time_ns[g[0]]) for g in groups]
    forward, backward = BodyTracker(bodies, settings), BodyTracker(bodies, settings)
    ahead = [forward.attend(s, t * 1e-9) for s, t in zip(instants, times, strict=True)]
    back = [backward.attend(s, -t * 1e-9) for s, t in zip(instants[::-1], times[::-1], strict=True)][::-1]
    labels = tracks.label.astype(object)
    parts = []
    for k, (one, two) in enumerate(zip(ahead, back, strict=True)):
        answers = _merged(one, two)
        parts.append(_poses(bodies, answers, instants[k], int(frames[k]), times[k]))
        for body, answer in zip(bodies, answers, strict=True):
            if answer.fit is not None:
                used = np.flatnonzero(answer.fit.rows >= 0)
                labels[groups[k][answer.fit.rows[used]]] = np.array(body.markers, dtype=object)[used]
    return joined_poses(parts), replace(tracks, label=labels.astype(np.str_))


def _merged(ahead: list[_Answer], back: list[_Answer]) -> list[_Answer]:
    """Return the forward answers; backward ones replace those withheld, where their points are free."""
    merged = list(ahead)
    for k, two in enumerate(back):
        if ahead[k].fit is not None or two.fit is None:
            continue
        taken = [a.fit.rows for a in merged if a.fit is not None]
        if not taken or not np.intersect1d(two.fit.rows[two.fit.rows >= 0], np.concatenate(taken)).size:
            merged[k] = two
    return merged


def _of_instant(points: Points | Samples | Tracks, frame: int) -> InstantPoints:
    if isinstance(points, Points):
        return instant_points(points.xyz, points.covariance)
    rows = points.frame == frame
    rows &= points.status == ("measured" if isinstance(points, Tracks) else 0)
    label = points.label[rows] if isinstance(points, Tracks) else None
    return instant_points(points.xyz[rows], points.covariance[rows], points.track[rows], label)


def _named(body: RigidBody, seen: InstantPoints) -> Array:
    """Return the point (m,) whose label is the name of each marker, -1 for none."""
    return np.array([seen.named.get(name, -1) for name in body.markers])


def _by_track(track: Array, seen: InstantPoints, rows: Array) -> Array:
    """Return ``rows`` (m,) with markers that have no point at the points of their previous tracks ``track`` (m,)."""
    if not seen.row_of:
        return rows
    rows, labelled = rows.copy(), set(seen.named.values())
    for k, identity in enumerate(track.tolist()):
        row = seen.row_of.get(identity, -1) if identity >= 0 and rows[k] < 0 else -1
        if row >= 0 and row not in labelled:
            rows[k] = row
    return rows


def _remember(state: _State, fit: BodyPoseFit, seen: InstantPoints, time_s: float, settings: BodySettings) -> None:
    step = time_s - state.time_s
    if 0.0 < step <= settings.coast_s:
        newest = np.concatenate(
            [(fit.translation - state.translation) / step, vector_of(fit.rotation @ state.rotation.T) / step]
        )
        state.rates = newest if not state.moving else FRESH * newest + (1 - FRESH) * state.rates
        state.moving = True
    elif step != 0.0:
        state.rates, state.moving = np.zeros(6), False
    state.rotation, state.translation, state.time_s = fit.rotation, fit.translation, time_s
    used = fit.rows >= 0
    state.track = np.where(used, seen.track[fit.rows], state.track)


def _poses(
    bodies: Sequence[RigidBody], answers: Sequence[_Answer], seen: InstantPoints, frame: int, time_ns: int
) -> BodyPoses:
    known = [(body, a) for body, a in zip(bodies, answers, strict=True) if a.fit is not None or a.count]
    if not known:
        return BodyPoses.none()
    n = len(known)
    fits = [a.fit for _, a in known]
    return BodyPoses(
        np.full(n, frame),
        np.full(n, time_ns),
        np.array([body.name for body, _ in known]),
        np.array([np.full(4, np.nan) if f is None else quaternion_from_rotation(f.rotation) for f in fits]),
        np.array([np.full(3, np.nan) if f is None else f.translation for f in fits]),
        np.array([np.full((6, 6), np.nan) if f is None else f.covariance for f in fits]),
        np.array([a.count for _, a in known]),
        np.array([np.nan if a.fit is None else a.fit.residual_m(body, seen) for body, a in known]),
        np.array(["withheld" if f is None else "measured" for f in fits]),
    )
