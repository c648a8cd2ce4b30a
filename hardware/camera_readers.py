"""Reading threads, one for each camera, so that no camera waits for another and buffers are freed at once."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

from hardware.driver import CameraDriver, DeviceError, Grabbed
from hardware.silence import POLL_S, PollingTime
from hardware.statistics import RigStatistics
from hardware.trigger import Trigger
from mosca.data.arrays import Array

REOPEN_S = 1.0
"""Interval at which a lost device is opened again."""
SILENT_S = 0.5
"""After this polling time without a frame a camera no longer holds back the others."""
QUEUED_BYTES = 1 << 30
"""Most bytes of images in the queue; further images are dropped and counted."""
log = logging.getLogger("mosca.hardware.readers")


class CameraReaders:
    """Reads ``drivers`` into one queue; a device that fails is opened again while the others go on.

    Parameters
    ----------
    drivers
        The present driver of each camera.
    statistics
        Where losses are counted and noted.
    reopen
        Opens, configures and arms a camera's device again; DeviceError where it does not answer.
    stop
        Ends the threads.
    """

    on_image: Callable[[Array], object] | None = None
    """Called with each image as it arrives, in its camera's thread."""

    def __init__(
        self,
        drivers: Mapping[str, CameraDriver],
        statistics: RigStatistics,
        reopen: Callable[[str], None],
        stop: threading.Event,
    ) -> None:
        self._drivers, self._statistics, self._reopen, self._stop = drivers, statistics, reopen, stop
        self.polling = {name: PollingTime() for name in drivers}
        self.lost: set[str] = set()
        """Cameras whose device does not answer now."""
        self.end_ns: int | None = None
        """Host time when the pulses ended [ns]; None before."""
        self._queue: queue.Queue[tuple[str, Grabbed | None]] = queue.Queue()
        self._queued_bytes = 0
        self._guard = threading.Lock()
        self._threads: list[threading.Thread] = []

    def start(self, trigger: Trigger) -> None:
        """Start the threads; ``trigger`` is informed of frames, polls and losses."""
        for name in self._drivers:
            thread = threading.Thread(target=self._run, args=(name, trigger), name=f"camera {name}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def join(self) -> None:
        """Wait for the threads; ``stop`` must be set."""
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def wake(self, name: str) -> None:
        """Let ``get`` return without a buffer."""
        self._queue.put((name, None))

    def get(self) -> tuple[str, Grabbed | None] | None:
        """Return the next camera and its buffer (None after ``wake``), or None when nothing came during a poll."""
        try:
            name, buffer = self._queue.get(timeout=POLL_S)
        except queue.Empty:
            return None
        if buffer is not None and buffer.image is not None:
            with self._guard:
                self._queued_bytes -= buffer.image.nbytes
        return name, buffer

    @property
    def empty(self) -> bool:
        """Whether nothing is queued."""
        return self._queue.empty()

    def active(self) -> list[str]:
        """Return the cameras whose next frame may have arrived unread: those that delivered lately."""
        return [n for n, polled in self.polling.items() if polled.idle_s < SILENT_S and n not in self.lost]

    def _run(self, name: str, trigger: Trigger) -> None:
        """Read one camera until the end; a lost device is reopened, again and again."""
        while not self._stop.is_set():
            began_ns = time.monotonic_ns()
            try:
                buffer = self._drivers[name].grab(POLL_S)
            except DeviceError as error:
                self._statistics.note(str(error))
                self.lost.add(name)
                trigger.camera_lost(name)
                if not self._reopened(name):
                    return
                self.lost.discard(name)
                self._statistics.cameras[name].reopened += 1
                continue
            if buffer is None:
                ended_ns = time.monotonic_ns()
                self.polling[name].timed_out(began_ns, ended_ns, self.end_ns)
                trigger.poll_timed_out(name, began_ns, ended_ns)
                continue
            self.polling[name].frame_arrived()
            trigger.frame_arrived(name, buffer.host_ns)
            if buffer.image is None:
                log.debug("camera '%s': block %s failed (%s)", name, buffer.block_id, buffer.note)
            elif self.on_image is not None:
                self.on_image(buffer.image)
            self._put(name, buffer)

    def _put(self, name: str, buffer: Grabbed) -> None:
        size = 0 if buffer.image is None else buffer.image.nbytes
        with self._guard:
            full = self._queued_bytes + size > QUEUED_BYTES
            self._queued_bytes += 0 if full else size
        if full:
            log.debug("camera '%s': block %s dropped, the queue is full", name, buffer.block_id)
            self._statistics.cameras[name].overrun += 1
            buffer = replace(buffer, image=None, note="no room to wait")
        self._queue.put((name, buffer))

    def _reopened(self, name: str) -> bool:
        """Close and reopen the camera until it answers; False when the take ends before."""
        while True:
            self._drivers[name].close()  # also one that was opened but could not be configured or armed
            if self._stop.wait(REOPEN_S):
                return False
            try:
                self._reopen(name)
            except DeviceError as error:
                log.debug("camera '%s': not opened again yet (%s)", name, error)
                continue
            self._statistics.note(f"camera '{name}': answers again")
            return True
