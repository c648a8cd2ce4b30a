"""Streams beside served cameras: tracks of the same instant at each pulse of the trigger line, on the same clock.

A pulse begins the cameras' exposure. The frame of its tracks has the pulse's number and, as its stamp, the middle of
the exposure. It is sent when the exposure is over.
"""

import queue
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from hardware.streams.content import TakeFrames
from hardware.streams.fault_line import FaultLine
from hardware.streams.faulted_sender import FaultedSender
from hardware.streams.stream_server import StreamServer
from hardware.streams.turns import UpAxis
from hardware.streams.values import StreamFrame
from mosca.data.arrays import Array
from mosca.data.joint_motion import JointMotion
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth, read_truth
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import read_bodies_csv
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.rigid_bodies.tracker import body_poses
from scenarios.run.take_files import take_files
from scenarios.score.bodies import rigid_bodies
from scenarios.spec.scenario import Scenario
from twin.cameras.exposure.shutter import pulse_time_s
from twin.scenes.scene import Scene
from twin.truth_log import joints_at

SIGMA_M = 1e-6
"""Stated standard deviation of true positions, so that poses can be fitted to them."""
TRUTH_FILE = "truth.npz"


def true_frames(spec: Scenario, scene: Scene, up: UpAxis) -> TakeFrames:
    """Return the true markers, bodies and person of a scenario at its pulses, as stream frames.

    Raises InputError for a flight, since its motion depends on results from its frames.
    """
    if spec.flight is not None:
        raise InputError("--stream: the truth of a flight is known when it is flown; give --tracks RUN")
    rate, exposure = spec.capture.frame_rate_hz, spec.capture.exposure_s
    times = np.array([pulse_time_s(k, rate) + exposure / 2 for k in range(spec.capture.pulses)])
    sampler = scene.sampler()
    xyz = np.array([sampler.at(float(at)).marker_xyz.copy() for at in times])
    time_ns = np.rint(times * 1e9).astype(np.int64)
    tracks = true_tracks(time_ns, scene.marker_names, xyz)
    bodies, joints = rigid_bodies(scene), joints_at(scene, times)
    motion = None
    if joints is not None:
        n, j = len(times), len(joints.names)
        none = np.zeros((n, j, 3, 3))
        motion = JointMotion(np.arange(n), time_ns, joints.names, joints.centre, none, joints.rotation, none)
    return TakeFrames(tracks, body_poses(tracks, bodies), bodies, up, joints=motion)


def true_tracks(time_ns: Array, names: tuple[str, ...], xyz: Array) -> Tracks:
    """Return true positions (t, m, 3) at instants (t,) as tracks."""
    t, m = xyz.shape[:2]
    n = t * m
    return Tracks(
        frame=np.repeat(np.arange(t), m),
        time_ns=np.repeat(time_ns, m),
        track=np.tile(np.arange(m), t),
        label=np.tile(np.array(names, np.str_), t),
        xyz=xyz.reshape(n, 3),
        covariance=np.broadcast_to(SIGMA_M**2 * np.eye(3), (n, 3, 3)),
        n_cameras=np.zeros(n),
        residual_px=np.full(n, np.nan),
        status=np.full(n, "measured"),
    )


def recorded_frames(recording: Path, up: UpAxis) -> TakeFrames:
    """Return the truth beside a recording; InputError where there is none."""
    path = (recording if recording.is_dir() else recording.parent) / TRUTH_FILE
    if not path.is_file():
        raise InputError(
            f"--stream: {path} is not there; give --tracks, a run folder or file of this recording's tracks"
        )
    truth: Truth = read_truth(path)
    return TakeFrames(true_tracks(truth.time_ns, truth.names, truth.xyz), up=up)


def tracked_frames(path: Path, up: UpAxis) -> TakeFrames:
    """Return the tracks and poses of a run folder, or of a file of tracks; their frames are the line's pulses."""
    files = take_files(path)
    poses = None if files.bodies is None else read_bodies_csv(files.bodies)
    return TakeFrames(read_tracks(files.tracks), poses, up=up)


class PulsedStream:
    """A device on the trigger line that sends a frame at each pulse. ``close`` ends it; a context is not needed.

    ``frames``: by pulse. ``length``: pulses after which the frames repeat, None: no repetition. ``faults``: faults
    that are applied to the frames, by the time from the first pulse on. ``sent``: number of pulses that had a frame.
    """

    def __init__(
        self,
        server: StreamServer,
        frames: Mapping[int, StreamFrame],
        exposure_ns: int,
        length: int | None = None,
        faults: FaultLine | None = None,
        period_s: float = 0.01,
    ) -> None:
        self._frames, self._exposure_ns, self._length, self._period_s = frames, exposure_ns, length, period_s
        self._server, self._sender = server, FaultedSender(server, faults)
        self.sent = 0
        self._first_ns: int | None = None
        self._due: queue.SimpleQueue[tuple[int, int] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="stream", daemon=True)
        self._thread.start()

    def pulse(self, number: int, time_ns: int) -> None:
        """Take pulse ``number``, whose edge is at the monotonic time ``time_ns``."""
        self._due.put((number, time_ns))

    def close(self) -> None:
        """Send the frames exposed until now, and end."""
        self._due.put(None)
        self._thread.join()

    def _run(self) -> None:
        waits_ns: int | None = None
        while True:
            try:
                due = self._due.get(timeout=_seconds_until(waits_ns))
            except queue.Empty:
                waits_ns = self._sender.deliver_due()
                continue
            if due is None:
                break
            self._send(*due)
            waits_ns = self._sender.deliver_due()
        self._sender.release()
        self._deliver_until(None)

    def _deliver_until(self, time_ns: int | None) -> None:
        """Deliver waiting frames, each at its time, until a monotonic time; None: all of them."""
        while (at_ns := self._sender.deliver_due()) is not None and (time_ns is None or at_ns < time_ns):
            time.sleep(_seconds_until(at_ns) or 0.0)
        time.sleep(_seconds_until(time_ns) or 0.0)

    def _send(self, number: int, time_ns: int) -> None:
        frame = self._frames.get(number if self._length is None else number % self._length)
        if frame is None:
            return
        self._first_ns = time_ns if self._first_ns is None else self._first_ns
        encoded = self._server.encoded(replace(frame, number=number))
        self._deliver_until(time_ns + self._exposure_ns)
        at_s, mid_ns = (time_ns - self._first_ns) * 1e-9, time_ns + self._exposure_ns // 2
        self._sender.send(encoded, at_s, mid_ns, self._period_s)
        self.sent += 1


def _seconds_until(time_ns: int | None) -> float | None:
    """Return the time [s] from now until a monotonic time, 0 where it is past; None for None."""
    return None if time_ns is None else max(0.0, (time_ns - time.monotonic_ns()) * 1e-9)
