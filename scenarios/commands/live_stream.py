"""Markers and bodies of a live run on the network, for clients of motion-capture systems."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Self

import numpy as np

from hardware.streams.content import StreamContent
from hardware.streams.skeletons import SkeletonPoses
from hardware.streams.values import FROM_MODEL, OCCLUDED, SEEN, StreamNames
from mosca.data.bodies import BodyPoses
from mosca.data.tracks import STATUSES, Samples
from mosca.formats.bodies.body_file import read_bodies
from mosca.rigid_bodies.tracker import BodyTracker
from mosca.skeleton.isb_angles import isb_angles
from mosca.skeleton.live import LivePose
from scenarios.commands.live_skeleton import LivePerson
from scenarios.commands.live_sources import LiveOptions, LiveSource
from scenarios.run.stream_servers import opened_streams
from scenarios.score.bodies import rigid_bodies

NO_LABELS: Mapping[tuple[int, int], str] = MappingProxyType({})


class LiveStream:
    """Serves each frame set's markers, the poses of bodies and a person's skeleton and joint angles; a context.

    Bodies are those of ``--bodies``, or a scenario's own; markers have the labels of ``person``, if there is one.
    ``where``: a line with the addresses of the server.
    """

    def __init__(self, options: LiveOptions, source: LiveSource, person: LivePerson | None = None) -> None:
        if options.bodies is not None:
            bodies = read_bodies(options.bodies)
        else:
            bodies = () if source.scene is None else rigid_bodies(source.scene)
        self._tracker = BodyTracker(bodies) if bodies else None
        labels = () if person is None else person.labels
        self._content = StreamContent(bodies, labels, options.up)
        self._label = {label: k for k, label in enumerate(self._content.labels)}
        example = None if person is None else person.example
        self._bones = None if example is None else SkeletonPoses(example, options.up)
        angles = () if example is None else isb_angles(example).names
        self._no_angles = np.full(len(angles), np.nan)
        self._session_ns = source.session_ns
        self._server = opened_streams(
            options.stream,
            [*self._content.model, *(() if self._bones is None else (self._bones.model,))],
            StreamNames(self._content.numbers, angles),
            source.frames.cameras[0].frame_rate_hz,
        )
        self.where = self._server.where()

    def step(
        self,
        frame: int,
        time_ns: int,
        samples: Samples,
        poses: Sequence[LivePose] = (),
        label_of: Mapping[tuple[int, int], str] = NO_LABELS,
    ) -> None:
        """Send the tracker's samples of one frame set, with the person's pose of that frame and its labels."""
        now = time.monotonic_ns()
        mid_ns = self._host_ns(time_ns, now)
        here = samples.select(np.flatnonzero(samples.frame == frame))
        label = np.array([self._label.get(label_of.get((frame, k), ""), -1) for k in here.track.tolist()], np.int64)
        named_first = np.argsort(label < 0, kind="stable")
        here, label = here.select(named_first), label[named_first]
        bodies = BodyPoses.none() if self._tracker is None else self._tracker.update(samples, frame, time_ns)
        seen = here.status == STATUSES.index("measured")
        markers = self._content.markers(
            here.xyz, label=label, track=here.track, params=np.where(seen, SEEN, OCCLUDED | FROM_MODEL)
        )
        made = self._content.frame(frame, time_ns, markers, self._content.bodies(bodies), label[label >= 0])
        if self._bones is not None:
            joints = next((one.joints for one in poses if one.frame == frame), None)
            angles = self._no_angles if joints is None else isb_angles(joints).angles[0]
            made = replace(made, skeletons=self._bones.posed(joints), angles=angles)
        self._server.send(made, mid_ns, now)

    def _host_ns(self, time_ns: int, now_ns: int) -> int:
        """Return a time of the frames' clock as host time, by a linear relation from a second ago to now."""
        at, before = self._session_ns(now_ns), self._session_ns(now_ns - 1_000_000_000)
        if at is None or before is None:
            return now_ns
        return now_ns - round((at - time_ns) * 1e9 / (at - before))

    def finish(self) -> list[str]:
        """End serving and return its account as lines."""
        self._server.close()
        return [f"stream: {line}" for line in (f"{self._server.frames} frames", *self._server.lines())]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.close()
