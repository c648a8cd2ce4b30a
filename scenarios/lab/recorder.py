"""Writing of frames to disk while they come: several threads pack, one writes, whole sets are lost when behind.

Frames wait where packing or the disk fall behind. To bound memory, a frame set whose first frame finds the queue full
is left out of the recording with all its cameras, and listed; single frames are never left out. Each camera's frames
stay in order. Written data reach the operating system at least every FLUSH_S. A frame that waits longer than
KEPT_AFTER_S for that, because of a slow disk or a busy machine, is copied to memory that outlives this process. At
the start, frames whose pulses are not known yet are copied there at once.
"""

import queue
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.recording import RecordingWriter

WAITING_BYTES = 1 << 29
FLUSH_S = 0.02
KEPT_AFTER_S = 0.045
HURRY_S, HURRY_BELOW, POLL_S = 0.03, 0.3, 0.003
REMEMBERED_PULSES = 2000


class LostSets:
    """Numbers of frame sets that were lost, as ranges; filled by one thread, read by any."""

    def __init__(self) -> None:
        self.ranges: list[tuple[int, int]] = []
        self.count = 0

    def add(self, first: int, last: int) -> None:
        """Add the sets ``first`` to ``last``, which are later than all earlier ones."""
        self.count += last - first + 1
        if self.ranges and first == self.ranges[-1][1] + 1:
            self.ranges[-1] = (self.ranges[-1][0], last)
        else:
            self.ranges.append((first, last))

    def text(self, most: int = 5) -> str:
        """Return the ranges in words, the first ``most`` of them."""
        texts = [f"{a}" if a == b else f"{a}-{b}" for a, b in self.ranges[:most]]
        return ", ".join(texts) + (f" and {len(self.ranges) - most} more" if len(self.ranges) > most else "")


@dataclass(eq=False)
class _Waiting:
    """A frame being written: ``slot`` of its copy in kept memory; ``safe`` once the operating system has it."""

    frame: Frame
    host_ns: int | None
    taken_ns: int
    slot: int | None = None
    safe: bool = False


class Recorder:
    """Takes frames, frame sets of detections and further messages, and writes them in a thread of its own.

    ``waiting_bytes``: most bytes of pixels that wait. ``workers``: threads that pack. ``failed``: reason why writing
    ended early (a full disk), None without a failure; later data are discarded. ``take`` is for one thread.
    """

    def __init__(
        self,
        writer: RecordingWriter,
        cameras: Sequence[CameraInfo],
        waiting_bytes: int = WAITING_BYTES,
        workers: int = 2,
    ) -> None:
        self.lost = LostSets()
        self.failed: BaseException | None = None
        self._writer = writer
        self._period_ns = 1e9 / cameras[0].frame_rate_hz
        self._set_bytes = sum(info.image_bytes for info in cameras)
        self._most = max(waiting_bytes, 2 * self._set_bytes)
        self._waiting = 0
        self._guard = threading.Lock()
        self._slots = threading.Lock()
        self._hurry_until_ns = 0
        self._taken_any = False
        self._early: dict[int, tuple[Array | None, int | None]] = {}
        self._unkept: deque[_Waiting] = deque()
        self._written: list[_Waiting] = []
        self._admitted: OrderedDict[int, bool] = OrderedDict()
        self._pool = ThreadPoolExecutor(workers, "pack")
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="write recording", daemon=True)
        self._thread.start()

    @property
    def behind(self) -> float:
        """Fill level of the queue, 0 to 1."""
        return self._waiting / self._most

    def take(self, frame: Frame, host_ns: int | None = None) -> bool:
        """Queue ``frame`` for writing; False where its set is left out. ``host_ns``: its arrival at this machine."""
        pulse = round(frame.time_ns / self._period_ns)
        self._taken_any = True
        if not self._admit(pulse):
            return False
        size = 0 if frame.image is None else frame.image.nbytes
        with self._guard:
            self._waiting += size
        now_ns = time.monotonic_ns()
        waiting = _Waiting(frame, host_ns, now_ns if host_ns is None else host_ns)
        if now_ns - waiting.taken_ns > KEPT_AFTER_S * 1e9:
            self._hurry_until_ns = now_ns + round(HURRY_S * 1e9)
        _, slot = self._early.pop(id(frame.image), (None, None))
        if slot is not None:
            waiting.slot = self._writer.keep(frame, host_ns, slot)
        packed = self._pool.submit(self._pack, frame)
        self._jobs.put(partial(self._write_frame, waiting, packed, size))
        if waiting.slot is None:
            self._unkept.append(waiting)
        self._keep_old()
        return True

    def keep_early(self, image: Array) -> None:
        """Keep the image of a frame that will come to ``take``, unless that has taken any yet; from any thread."""
        if self._taken_any:
            return
        slot = self._writer.reserve(image)
        if slot is not None:
            self._early[id(image)] = (image, slot)

    def take_set(self, frame_set: FrameSet, detections: Mapping[str, Detections], host_ns: Mapping[str, int]) -> None:
        """Queue the detections of a frame set for writing."""
        self._jobs.put(partial(self._writer.write_set, frame_set, detections, host_ns))

    def write_message(self, channel: str, time_ns: int, data: bytes | Mapping[str, Any]) -> None:
        """Queue a message of a further channel for writing; may be called by any thread."""
        self._jobs.put(partial(self._writer.write_channel, channel, time_ns, data))

    def close(self) -> None:
        """Write waiting data and end the threads; may be called twice."""
        if self._thread.is_alive():
            self._jobs.put(None)
            self._thread.join()
        self._pool.shutdown()

    def _admit(self, pulse: int) -> bool:
        known = self._admitted.get(pulse)
        if known is None:
            known = self._admitted[pulse] = self._waiting + self._set_bytes <= self._most
            if not known:
                self.lost.add(pulse, pulse)
            if len(self._admitted) > REMEMBERED_PULSES:
                self._admitted.popitem(last=False)
        return known

    def _pack(self, frame: Frame) -> bytes:
        """Pack ``frame``, but wait while old frames arrive and the queue has space: those are kept first."""
        while time.monotonic_ns() < self._hurry_until_ns and self.behind < HURRY_BELOW:
            time.sleep(POLL_S)
        return self._writer.pack(frame)

    def _keep_old(self) -> None:
        """Copy all waiting frames to the tail once the oldest of them has waited too long."""
        while self._unkept and self._unkept[0].safe:
            self._unkept.popleft()
        if not self._unkept or time.monotonic_ns() - self._unkept[0].taken_ns < KEPT_AFTER_S * 1e9:
            return
        while self._unkept:
            waiting = self._unkept.popleft()
            with self._slots:
                if not waiting.safe:
                    waiting.slot = self._writer.keep(waiting.frame, waiting.host_ns)

    def _flush(self) -> None:
        self._writer.flush()
        with self._slots:
            for waiting in self._written:
                waiting.safe = True
                if waiting.slot is not None:
                    self._writer.forget(waiting.slot)
        self._written.clear()

    def _write_frame(self, waiting: _Waiting, packed: "Future[bytes]", size: int) -> None:
        try:
            self._writer.write(waiting.frame, waiting.host_ns, packed.result())
            self._written.append(waiting)
        finally:
            with self._guard:
                self._waiting -= size

    def _write(self) -> None:
        flushed, clean = time.monotonic(), True
        while True:
            try:
                job = self._jobs.get(timeout=FLUSH_S)
            except queue.Empty:
                job = _nothing
            if job is None:
                return
            try:
                if self.failed is None:
                    job()
                    clean = clean and job is _nothing
                    if not clean and time.monotonic() - flushed >= FLUSH_S:
                        self._flush()
                        flushed, clean = time.monotonic(), True
            except BaseException as error:  # raised in the capturing thread
                self.failed = error


def _nothing() -> None:
    """Do nothing: there is no job, only a flush is due."""
