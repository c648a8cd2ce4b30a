"""A detecting station: frames of its own cameras become detections, sent to the station that reconstructs.

The frames are processed one by one as they come, with the same detection, and the same statistics of earlier frames,
as in a local run. So the sent detections are those of a local run. A thread reads the source and notes the arrival of
each frame. A station that falls behind leaves out its oldest frames, and reports them.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hardware.transport.sender import Sender
from mosca.data.frames import Frame, FrameSource, mid_exposure_ns
from mosca.detection.detect import DetectionSettings, detect_with_statistics
from mosca.detection.scheduler import DelayedStatistics
from scenarios.lab.station_background import Backgrounds
from scenarios.run.priority import before_others, prompt

BACKLOG_S, LEAST_BACKLOG = 1.0, 12
"""Time, and number of frames of a camera, that may wait for detection; then the oldest is left out. A rig holds its
first frames until their pulses are known, and then gives all of them at once."""
WAIT_S = 0.1


class Arrivals:
    """Frames of a source with the arrival time of each; iterate once. ``close`` ends the reading thread.

    ``arrival_ns``: arrival of a frame. ``end``: makes the source end; else reading stops at its next frame.
    """

    def __init__(
        self, source: FrameSource, arrival_ns: Callable[[Frame], int], end: Callable[[], None] = lambda: None
    ) -> None:
        self._end = end
        rate_hz = max((info.frame_rate_hz for info in source.cameras), default=0.0)
        self.longest = max(round(BACKLOG_S * rate_hz), LEAST_BACKLOG) * max(len(source.cameras), 1)
        self._source, self._arrival_ns = source, arrival_ns
        self._waiting: deque[tuple[Frame, int]] = deque()
        self._changed = threading.Condition()
        self._over, self._stop = False, False
        self._failed: BaseException | None = None
        self._reader = threading.Thread(target=self._read, name="station frames", daemon=True)
        self._reader.start()

    def __iter__(self) -> Iterator[tuple[Frame, int, bool] | None]:
        """Yield (frame, arrival, whether to detect in it), or None when no frame came for a while."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._over, WAIT_S)
                taken = self._waiting.popleft() if self._waiting else None
                behind = len(self._waiting) >= self.longest
                over = self._over
            if taken is not None:
                yield (*taken, not behind)
            elif over:
                break
            else:
                yield None
        if self._failed is not None:
            raise self._failed

    def close(self) -> None:
        """Stop reading and free the source; may be called twice."""
        self._stop = True
        self._end()
        self._reader.join()
        self._source.close()

    def _read(self) -> None:
        try:
            for frame in self._source:
                arrival = self._arrival_ns(frame)
                with self._changed:
                    self._waiting.append((frame, arrival))
                    self._changed.notify()
                if self._stop:
                    break
        except BaseException as error:  # kept, and raised in the thread that iterates
            self._failed = error
        with self._changed:
            self._over = True
            self._changed.notify()


class PulseCount:
    """Pulse numbers of frames whose stamps are on one clock: each camera's count continues from its last frame.

    The first of all frames sets the count, at ``time_ns / period``: 0 for a source that counts from the first pulse.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = 1e9 / rate_hz
        self._first: tuple[int, int] | None = None
        self._last: dict[str, tuple[int, int]] = {}

    def of(self, frame: Frame) -> int:
        """Return the pulse of ``frame``."""
        if self._first is None:
            self._first = (round(frame.time_ns / self._period_ns), frame.time_ns)
        pulse, time_ns = self._last.get(frame.camera, self._first)
        pulse += round((frame.time_ns - time_ns) / self._period_ns)
        self._last[frame.camera] = (pulse, frame.time_ns)
        return pulse


@dataclass
class StationTotals:
    """Totals of a station: ``frames`` came, ``detected`` were processed, ``targets`` were found in them."""

    frames: int = 0
    detected: int = 0
    targets: int = 0
    seconds: float = 0.0


def run_station(
    source: FrameSource,
    sender: Sender,
    settings: DetectionSettings,
    arrival_ns: Callable[[Frame], int] | None = None,
    every: Callable[[], bool] = lambda: True,
    end: Callable[[], None] = lambda: None,
    backgrounds: Backgrounds | None = None,
) -> StationTotals:
    """Detect and send until the source ends or ``every``, called between frames, returns False.

    ``arrival_ns``: arrival of a frame by the sender's clock. ``end`` makes the source end. ``backgrounds``: images
    that are subtracted. Source and sender are closed; the other stations are informed when the source fails.
    """
    with before_others(), prompt():
        return _run(source, sender, settings, arrival_ns, every, end, backgrounds or Backgrounds())


def _run(
    source: FrameSource,
    sender: Sender,
    settings: DetectionSettings,
    arrival_ns: Callable[[Frame], int] | None,
    every: Callable[[], bool],
    end: Callable[[], None],
    backgrounds: Backgrounds,
) -> StationTotals:
    totals = StationTotals()
    infos = {info.name: info for info in source.cameras}
    count = PulseCount(source.cameras[0].frame_rate_hz)
    statistics = {name: DelayedStatistics(name) for name in infos}
    for depth in {info.bit_depth for info in source.cameras}:
        _warm(settings, depth)
    arrivals = Arrivals(source, arrival_ns or (lambda frame: sender.now_ns()), end)
    try:
        for one in arrivals:
            if not every():
                break
            if one is None:
                continue
            frame, arrived_ns, wanted = one
            if not totals.frames:
                sender.set_state("running")
            totals.frames += 1
            pulse = count.of(frame)
            if backgrounds.takes(frame):
                continue
            header = (frame.camera, pulse, mid_exposure_ns(frame), frame.exposure_ns, arrived_ns)
            if frame.image is None:
                sender.send(*header, None, "corrupt" if frame.status == "corrupt" else "no frame")
            elif not wanted:
                sender.skipped += 1
                sender.send(*header, None, "skipped")
            else:
                begun = time.perf_counter()
                own = statistics[frame.camera]
                depth = infos[frame.camera].bit_depth
                (found,), new = detect_with_statistics(
                    [frame.image],
                    [frame.camera],
                    settings,
                    depth,
                    [backgrounds.of(frame.camera)],
                    statistics=own.for_frame_set(pulse),
                )
                own.add(pulse, new)
                sender.send(*header, found)
                totals.detected += 1
                totals.targets += len(found)
                totals.seconds += time.perf_counter() - begun
    except Exception as error:
        sender.set_state("failed", str(error))
        raise
    finally:
        arrivals.close()
        sender.close()
    return totals


def _warm(settings: DetectionSettings, bit_depth: int) -> None:
    """Detect in a synthetic image, so that all is compiled and loaded before the first frame."""
    image = np.zeros((64, 64), np.uint8 if bit_depth <= 8 else np.uint16)
    image[28:34, 29:35] = 2**bit_depth - 56
    detect_with_statistics([image], ["warming"], settings, bit_depth)
