"""Live view of a capture in the Rerun viewer: some frame sets a second, without slowing down the capture.

Frames are offered while they pass. Only the newest whole frame set is kept. A thread takes it, detects and, with a
calibrated rig, measures points. The thread rests at least as long as it worked, and takes nothing while the recording
is behind.
"""

import statistics
import threading
import time
from collections.abc import Callable, Sequence

import numpy as np

from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import match
from mosca.data.frames import CameraInfo, Frame, FrameSet, mid_exposure_ns
from mosca.data.rays import Predicted
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.detection.disc_fit.camera_statistics import NO_STATISTICS
from mosca.detection.scheduler import FrameSetDetector
from mosca.pipeline import MOST_DETECTIONS, PipelineSettings
from reports.viewer import RerunLog
from reports.viewer_process import SHOWN_HZ

LEAST_REST_S = 0.05
BEHIND = 0.1
"""Fill level of the recording's queue above which nothing is shown."""
OPEN_PULSES = 4


class LiveView:
    """Shows the frames given to ``offer``. ``rig`` None: cameras without calibration, side by side and without 3D.

    ``behind``: fill level of the recording's queue, 0 to 1. ``shown``: frame sets logged so far; ``failed``: reason
    why showing ended early.
    """

    def __init__(
        self,
        log: RerunLog,
        cameras: Sequence[CameraInfo],
        rig: Rig | None,
        settings: PipelineSettings,
        behind: Callable[[], float],
    ) -> None:
        self.shown = 0
        self.failed: Exception | None = None
        self._log, self._rig, self._settings, self._behind = log, rig, settings, behind
        self._look = FrameSetDetector(settings.detection, {info.name: info.bit_depth for info in cameras})
        self._names = tuple(info.name for info in cameras)
        self._period_ns = 1e9 / cameras[0].frame_rate_hz
        self._open: dict[int, dict[str, Frame]] = {}
        self._newest: FrameSet | None = None
        self._due = 0.0
        self._changed = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="live view", daemon=True)
        self._thread.start()

    def offer(self, frame: Frame) -> None:
        """Take a frame if it may be shown; takes almost no time. For one thread."""
        if frame.image is None or time.monotonic() < self._due or self._behind() > BEHIND:
            return
        pulse = round(frame.time_ns / self._period_ns)
        here = self._open.setdefault(pulse, {})
        here[frame.camera] = frame
        whole = len(here) == len(self._names)
        if whole or len(self._open) > OPEN_PULSES:
            oldest = pulse if whole else min(self._open)
            frames = self._open[oldest]
            self._open.clear()
            time_ns = round(statistics.median(mid_exposure_ns(one) for one in frames.values()))
            self._newest = FrameSet(oldest, time_ns, frames)
            self._due = time.monotonic() + 1 / SHOWN_HZ
            self._changed.set()

    def close(self) -> None:
        """End showing; may be called twice."""
        self._stop.set()
        self._changed.set()
        self._thread.join()

    def _run(self) -> None:
        while True:
            self._changed.wait()
            self._changed.clear()
            if self._stop.is_set():
                return
            frame_set = self._newest
            if frame_set is None:
                continue
            started = time.monotonic()
            try:
                self._show(frame_set)
            except Exception as error:  # a view that fails must not end the capture; it is noted at its end
                self.failed = error
                return
            self.shown += 1
            self._stop.wait(max(time.monotonic() - started, LEAST_REST_S))

    def _show(self, frame_set: FrameSet) -> None:
        detections, _, _ = self._look.detect(frame_set, NO_STATISTICS)
        images = {name: frame.image for name, frame in frame_set.frames.items() if frame.image is not None}
        xyz = None
        if self._rig is not None and all(len(found) <= MOST_DETECTIONS for found in detections.values()):
            s = self._settings.match
            sigma = np.full(len(self._rig.cameras), s.camera_sigma_px)
            bundle = make_ray_table(self._rig, detections, sigma, s.target)
            low, high = self._settings.volume or ((-np.inf,) * 3, (np.inf,) * 3)
            volume = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
            xyz = match(bundle, Predicted.nothing(), s, volume, 0.0).xyz
        self._log.log_step(frame_set.pulse, frame_set.time_ns, images, detections, xyz)


def uncalibrated(cameras: Sequence[CameraInfo]) -> Rig:
    """Return cameras that only serve to show images: side by side, with parallel axes."""
    return Rig(
        tuple(
            Camera(
                info.name, info.width, info.height,
                OpenCVLens(info.width, info.width, (info.width - 1) / 2, (info.height - 1) / 2),
                Pose(np.eye(3), np.array([0.5 * number, 0.0, 0.0])),
            )
            for number, info in enumerate(cameras)
        )
    )  # fmt: skip
