"""Tracks and poses of bodies as stream frames: numbers, labels, and the axis that points up.

Bodies are numbered from 1 in the order given; labels that belong to no body are members of one more asset,
"markers". A labelled marker's number is 65536 times its asset's number plus its place in the asset, counted from 1,
as in Motive. Marker sets hold all their markers in each frame. A marker that is not seen keeps its last position
((0, 0, 0) before it is first seen), and the list of labelled markers leaves it out. A body without a pose keeps its
last one and is not ``TRACKED``.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from hardware.streams.skeletons import SkeletonPoses
from hardware.streams.turns import UP, UP_TURN, UpAxis, product
from hardware.streams.values import (
    BODY,
    FROM_MODEL,
    HAS_MODEL,
    MARKER,
    OCCLUDED,
    SEEN,
    TRACKED,
    UNLABELLED,
    StreamedBody,
    StreamedSet,
    StreamFrame,
    StreamModel,
    StreamNames,
)
from mosca.data.arrays import Array
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JointMotion
from mosca.data.tracks import Tracks

LOOSE, ALL = "markers", "all"
"""Marker sets: labels without a body, and every label."""
_PARAMS = {"measured": SEEN, "edited": SEEN, "filled": OCCLUDED | FROM_MODEL, "predicted": OCCLUDED | FROM_MODEL}


class StreamContent:
    """Makes frames of markers and bodies; keeps the last positions.

    ``bodies``: their names, or definitions, whose markers are streamed too. ``labels``: those that may occur.
    ``size_m``: diameter stated for each marker; 0: not known. ``model``: the definitions to send.
    """

    def __init__(
        self,
        bodies: Sequence[RigidBody | str] = (),
        labels: Sequence[str] = (),
        up: UpAxis = "z",
        size_m: float = 0.0,
    ) -> None:
        self.labels = tuple(dict.fromkeys(label for label in labels if label))
        self._bodies = {body if isinstance(body, str) else body.name: k for k, body in enumerate(bodies)}
        self._up, self._turn, self._size_m = UP[up], UP_TURN[up], size_m
        index = {label: k for k, label in enumerate(self.labels)}
        defined = [body for body in bodies if isinstance(body, RigidBody)]
        owned = {marker for body in defined for marker in body.markers}
        sets = {body.name: [m for m in body.markers if m in index] for body in defined}
        sets[LOOSE] = [label for label in self.labels if label not in owned]
        numbers = {**{name: k + 1 for name, k in self._bodies.items()}, LOOSE: len(bodies) + 1}
        self._numbers: Array = np.zeros(len(self.labels), np.uint32)
        for name, markers in sets.items():
            body = next((one for one in defined if one.name == name), None)
            for k, marker in enumerate(markers):
                place = k if body is None else body.markers.index(marker)
                self._numbers[index[marker]] = numbers[name] << 16 | (place + 1) & 0xFFFF
        sets = {name: markers for name, markers in (*sets.items(), (ALL, list(self.labels))) if markers}
        self._sets = tuple((name, np.array([index[m] for m in markers])) for name, markers in sets.items())
        self.model: StreamModel = [
            *(_streamed(body, k + 1) for k, body in enumerate(bodies)),
            *(StreamedSet(name, tuple(markers)) for name, markers in sets.items()),
        ]
        self._places: Array = np.zeros((len(self.labels), 3), "<f4")
        self._rows: Array = np.zeros(len(bodies), BODY)
        self._rows["id"], self._rows["quaternion"] = np.arange(1, len(bodies) + 1), [0.0, 0.0, 0.0, 1.0]

    @property
    def numbers(self) -> dict[str, int]:
        """The number that each label's marker has in frames."""
        return dict(zip(self.labels, self._numbers.tolist(), strict=True))

    def markers(
        self,
        xyz: Array,
        *,
        label: Array | None = None,
        track: Array | None = None,
        params: Array | None = None,
        residual: Array | None = None,
    ) -> Array:
        """Return records (n,) MARKER of positions ``xyz`` (n, 3) [m, world, Z up], of one frame or of many.

        ``label``: (n,) index into ``labels``, -1 without one; ``track``: (n,) number of those without a label;
        ``params``: (n,) flags; ``residual``: (n,) [m]. Defaults: no labels, numbers from 1, ``SEEN``, 0 (not known).
        """
        n = len(xyz)
        label = np.full(n, -1) if label is None else label
        named = label >= 0
        made = np.zeros(n, MARKER)
        made["position"] = xyz @ self._up.T
        made["size"] = self._size_m
        made["residual"] = 0.0 if residual is None else residual
        made["id"] = (np.arange(1, n + 1) if track is None else np.asarray(track) + 1) & 0xFFFF
        made["id"][named] = self._numbers[label[named]]
        made["params"] = (SEEN if params is None else params) | np.where(named, HAS_MODEL, UNLABELLED)
        return made

    def bodies(self, poses: BodyPoses) -> Array:
        """Return records (n,) BODY of poses, of one frame or of many; those withheld are not ``TRACKED``."""
        made = np.zeros(len(poses), BODY)
        names, which = np.unique(poses.body, return_inverse=True)
        made["id"] = np.array([self._bodies[name] + 1 for name in names.tolist()], np.uint32)[which]
        turned = product(self._turn, poses.quaternion.T)
        made["quaternion"] = np.stack(turned, axis=1)[:, [1, 2, 3, 0]]
        made["position"] = poses.position @ self._up.T
        made["error"] = np.nan_to_num(poses.residual_m)
        made["params"] = np.where(poses.status == "measured", TRACKED, 0)
        return made

    def frame(
        self, number: int, time_ns: int, markers: Array, bodies: Array, label: Array | None = None
    ) -> StreamFrame:
        """Return the frame of its ``markers`` (n,) and ``bodies`` (b,).

        ``label``: (m,) for the first m markers, the only ones that have a label.
        """
        position = markers["position"]
        named = 0
        if label is not None:
            named = len(label)
            self._places[label] = position[:named]
        self._rows["params"] = 0
        tracked = bodies[bodies["params"] == TRACKED]
        self._rows[tracked["id"] - 1] = tracked
        return StreamFrame(
            number=number,
            timestamp_s=time_ns * 1e-9,
            marker_sets=tuple((name, self._places[rows]) for name, rows in self._sets),
            other=position[named:],
            bodies=self._rows.copy(),
            markers=markers,
        )


class TakeFrames:
    """The frames of a take, in order: all its tracks and the poses of ``bodies`` (definitions, or the poses' names).

    ``joints``, ``angles``: of a person, streamed as a skeleton and as joint angles. ``times_ns``: (f,) times of the
    frames, which are those of all parts. ``names``: the meaning of numbers in frames. Iterate once or more.
    """

    def __init__(
        self,
        tracks: Tracks,
        poses: BodyPoses | None = None,
        bodies: Sequence[RigidBody] = (),
        up: UpAxis = "z",
        size_m: float = 0.0,
        joints: JointMotion | None = None,
        angles: JointAngles | None = None,
    ) -> None:
        # in each frame those with a label come first
        tracks = tracks.select(np.lexsort((tracks.track, tracks.label == "", tracks.frame)))
        self._tracks, self._poses = tracks, BodyPoses.none() if poses is None else poses
        names = [body.name for body in bodies]
        others = [name for name in dict.fromkeys(self._poses.body.tolist()) if name not in names]
        found, self._label = np.unique(tracks.label, return_inverse=True)
        self._made_of = ([*bodies, *others], found.tolist(), up, size_m)
        content = StreamContent(*self._made_of)
        self._skeleton = None if joints is None else SkeletonPoses(joints, up)
        self._angles = angles
        self.model = [*content.model, *(() if self._skeleton is None else (self._skeleton.model,))]
        self.numbers = content.numbers
        self.names = StreamNames(self.numbers, () if angles is None else angles.names)
        self.body_names: tuple[str, ...] = (*names, *others)
        if len(found) and found[0] == "":
            self._label = self._label - 1
        params: Array = np.zeros(len(tracks), np.uint16)
        for status, flags in _PARAMS.items():
            params[tracks.status == status] = flags
        sigma = np.sqrt(np.trace(tracks.covariance, axis1=1, axis2=2) / 3)
        residual = np.where(np.isfinite(sigma), sigma, 0.0)
        self._markers = content.markers(
            tracks.xyz, label=self._label, track=tracks.track, params=params, residual=residual
        )
        self._poses = self._poses.select(np.argsort(self._poses.frame, kind="stable"))
        self._rows = content.bodies(self._poses)
        parts = [part for part in (tracks, self._poses, joints, angles) if part is not None]
        frames = np.concatenate([part.frame for part in parts])
        times = np.concatenate([part.time_ns for part in parts])
        self._frames, first = np.unique(frames, return_index=True)
        self.times_ns: Array = times[first]

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def rate_hz(self) -> float:
        """Frames a second: the inverse of the median time between frames; 100 where there is one frame."""
        if len(self) < 2:
            return 100.0
        steps = np.diff(self.times_ns) / np.diff(self._frames)
        return float(1e9 / np.median(steps))

    def __iter__(self) -> Iterator[StreamFrame]:
        content, frames = StreamContent(*self._made_of), self._frames
        edges = [np.searchsorted(one.frame, [frames, frames + 1]).T.tolist() for one in (self._tracks, self._poses)]
        labelled = np.concatenate([[0], np.cumsum(self._label >= 0)])
        if self._skeleton is not None:
            self._skeleton.restart()
        for number, time_ns, (first, last), posed in zip(
            frames.tolist(), self.times_ns.tolist(), *edges, strict=True
        ):
            label = self._label[first : first + int(labelled[last] - labelled[first])]
            made = content.frame(number, time_ns, self._markers[first:last], self._rows[slice(*posed)], label)
            yield self._with_person(made)

    def _with_person(self, frame: StreamFrame) -> StreamFrame:
        """Return a frame with the person's skeleton and joint angles, where the take has them."""
        if self._skeleton is not None:
            frame = replace(frame, skeletons=self._skeleton.at(frame.number))
        if self._angles is not None:
            found = np.flatnonzero(self._angles.frame == frame.number)
            values = self._angles.angles[found[0]] if len(found) else np.full(len(self._angles.names), np.nan)
            frame = replace(frame, angles=values)
        return frame


def _streamed(body: RigidBody | str, number: int) -> StreamedBody:
    if isinstance(body, str):
        return StreamedBody(body, number)
    places = tuple((float(x), float(y), float(z)) for x, y, z in body.positions)
    return StreamedBody(body.name, number, body.markers, places)
