"""Markers and bodies of a live run on the network, for clients of motion-capture systems."""

import time
from typing import Self

import numpy as np

from hardware.streams.content import StreamContent
from hardware.streams.values import FROM_MODEL, OCCLUDED, SEEN, StreamNames
from mosca.data.bodies import BodyPoses
from mosca.data.tracks import STATUSES, Samples
from mosca.formats.bodies.body_file import read_bodies
from mosca.rigid_bodies.tracker import BodyTracker
from scenarios.commands.live_sources import LiveOptions, LiveSource
from scenarios.run.stream_servers import opened_streams
from scenarios.score.bodies import rigid_bodies


class LiveStream:
    """Serves each frame set's markers, without labels, and the poses of bodies; a context.

    Bodies are those of ``--bodies``, or a scenario's own. ``where``: a line that says where it serves.
    """

    def __init__(self, options: LiveOptions, source: LiveSource) -> None:
        if options.bodies is not None:
            bodies = read_bodies(options.bodies)
        else:
            bodies = () if source.scene is None else rigid_bodies(source.scene)
        self._tracker = BodyTracker(bodies) if bodies else None
        self._content = StreamContent(bodies, up=options.up)
        self._session_ns = source.session_ns
        self._server = opened_streams(
            options.stream,
            self._content.model,
            StreamNames(self._content.numbers),
            source.frames.cameras[0].frame_rate_hz,
        )
        self.where = self._server.where()

    def step(self, frame: int, time_ns: int, samples: Samples) -> None:
        """Send the tracker's samples of one frame set."""
        now = time.monotonic_ns()
        mid_ns = self._host_ns(time_ns, now)
        here = samples.select(np.flatnonzero(samples.frame == frame))
        poses = BodyPoses.none() if self._tracker is None else self._tracker.update(samples, frame, time_ns)
        seen = here.status == STATUSES.index("measured")
        markers = self._content.markers(
            here.xyz, track=here.track, params=np.where(seen, SEEN, OCCLUDED | FROM_MODEL)
        )
        made = self._content.frame(frame, time_ns, markers, self._content.bodies(poses))
        self._server.send(made, mid_ns, now)

    def _host_ns(self, time_ns: int, now_ns: int) -> int:
        """Return a time of the frames' clock in host time; that clock runs straight from a second ago to now."""
        at, before = self._session_ns(now_ns), self._session_ns(now_ns - 1_000_000_000)
        if at is None or before is None:
            return now_ns
        return now_ns - round((at - time_ns) * 1e9 / (at - before))

    def finish(self) -> list[str]:
        """End serving and return what became of it as lines."""
        self._server.close()
        return [f"stream: {line}" for line in (f"{self._server.frames} frames", *self._server.lines())]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.close()
