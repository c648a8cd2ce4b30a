"""The thread that reads the rig during a capture, and passes frames, or the detections in them, to the recorder."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hardware.pulse_numbers.camera_state import NumberedBuffer
from hardware.source import HardwareSource
from mosca.data.frames import Frame, WrappedSource
from mosca.synchronisation import Assembly
from scenarios.lab.recorder import LostSets, Recorder

if TYPE_CHECKING:
    from mosca.pipeline import PipelineSettings
    from scenarios.lab.live_view import LiveView

FEWEST_WAITING, MOST_WAITING = 2, 500
"""Least and largest number of frame sets that may wait for detection."""
REMEMBERED_FRAMES = 20_000
STAMPS = ("index", "block", "device_ns", "host_ns", "pulse", "found")
"""Recorded values of each frame's buffer: count of the camera, count of the stream, raw stamp of the camera's clock,
arrival, pulse and how that was found."""


@dataclass
class FrameCounts:
    """One camera's frames so far: ``whole`` and ``failed``, of ``pulses`` different pulses, ``last`` the newest."""

    whole: int = 0
    failed: int = 0
    pulses: int = 0
    last: int = -1
    left_out: int = 0
    """Whole frames that belong to lost frame sets."""


class Intake:
    """Reads ``source`` to its end on a thread. ``settings``: those of detection; None: the frames are recorded.

    ``cameras``: counts of frames; ``assembly``: their grouping (with detection); ``lost``: frame sets for which there
    was no time.
    """

    def __init__(
        self,
        source: HardwareSource,
        recorder: Recorder,
        settings: "PipelineSettings | None",
        view: "LiveView | None",
        waiting_bytes: int,
    ) -> None:
        self.cameras = {info.name: FrameCounts() for info in source.cameras}
        self.assembly = Assembly()
        self.lost = recorder.lost if settings is None else LostSets()
        self._source, self._recorder = source, recorder
        self._settings, self._view = settings, view
        set_bytes = sum(info.image_bytes for info in source.cameras)
        self._queued = min(max(waiting_bytes // set_bytes, FEWEST_WAITING), MOST_WAITING)
        self._period_ns = 1e9 / source.cameras[0].frame_rate_hz
        self._stamps: dict[str, dict[str, list[Any]]] = {}
        self._arrivals: OrderedDict[tuple[str, int], int] = OrderedDict()
        self._guard = threading.Lock()
        self._failed: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)

    @property
    def running(self) -> bool:
        """Whether frames may still come."""
        return self._thread.is_alive()

    @property
    def pulses(self) -> int:
        """Number of pulses so far."""
        return max(seen.last for seen in self.cameras.values()) + 1

    def start(self) -> None:
        """Begin to read, which arms the cameras and starts the pulses."""
        self._thread.start()

    def wait(self, seconds: float) -> None:
        """Wait for the end, at most for ``seconds``."""
        self._thread.join(seconds)

    def check(self) -> None:
        """Raise the error that ended the reading early, if any."""
        if self._failed is not None:
            raise self._failed

    def close(self) -> None:
        """Stop the source and wait for the thread; may be called twice."""
        self._source.stop()
        if self._thread.is_alive():
            self._thread.join()

    def new_stamps(self) -> dict[str, dict[str, list[Any]]]:
        """Return camera -> ``STAMPS`` of the frames since the last call."""
        with self._guard:
            stamps, self._stamps = self._stamps, {}
        return stamps

    def _run(self) -> None:
        try:
            if self._settings is None:
                for frame, numbered in self._source.with_buffers():
                    self._count(frame, numbered)
                    kept = self._recorder.take(frame, numbered.buffer.host_ns)
                    self.cameras[frame.camera].left_out += not kept and frame.image is not None
            else:
                self._detect(self._settings)
        except BaseException as error:  # raised in the capturing thread by ``check``
            self._failed = error

    def _detect(self, settings: "PipelineSettings") -> None:
        from scenarios.lab.detecting import detected  # compiled code is loaded only where it is used

        watched = _Counted(self._source, self._count)
        following = 0
        for frame_set, detections in detected(watched, settings, self.assembly, self._queued):
            if frame_set.pulse > following:
                self.lost.add(following, frame_set.pulse - 1)
            following = frame_set.pulse + 1
            with self._guard:
                arrived = {n: self._arrivals.pop((n, f.index), 0) for n, f in frame_set.frames.items()}
            self._recorder.take_set(frame_set, detections, {n: t for n, t in arrived.items() if t})

    def _count(self, frame: Frame, numbered: NumberedBuffer) -> None:
        """Count ``frame``, keep its buffer's stamps, offer it to the view."""
        seen = self.cameras[frame.camera]
        seen.whole += frame.image is not None
        seen.failed += frame.image is None
        pulse, buffer = round(frame.time_ns / self._period_ns), numbered.buffer
        seen.pulses += pulse > seen.last
        seen.last = max(seen.last, pulse)
        if self._view is not None:
            self._view.offer(frame)
        with self._guard:
            kept = self._stamps.setdefault(frame.camera, {key: [] for key in STAMPS})
            values = (frame.index, buffer.block_id, buffer.device_ns, buffer.host_ns, numbered.pulse, numbered.found)
            for key, value in zip(STAMPS, values, strict=True):
                kept[key].append(value)
            if self._settings is not None:
                self._arrivals[frame.camera, frame.index] = buffer.host_ns
                if len(self._arrivals) > REMEMBERED_FRAMES:
                    self._arrivals.popitem(last=False)


class _Counted(WrappedSource):
    """A source that passes each frame to ``count`` on its way."""

    def __init__(self, source: HardwareSource, count: Callable[[Frame, NumberedBuffer], object]) -> None:
        super().__init__(source)
        self._rig, self._count = source, count

    def __iter__(self) -> Iterator[Frame]:
        for frame, numbered in self._rig.with_buffers():
            self._count(frame, numbered)
            yield frame
