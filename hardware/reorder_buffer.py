"""Reorder buffer: releases the frames of a pulse once every active camera has reached it.

On a busy machine one camera's reading thread may run for seconds while another waits. Frame grouping waits for a few
pulses only, and a frame that is delivered later is lost to its frame set although it was received in time. So frames
wait here until every camera that delivers has reached their pulse; a silent or lost camera is not waited for.
"""

import heapq
import itertools
from collections.abc import Collection, Iterator, Sequence

from hardware.pulse_numbers.camera_state import NumberedBuffer
from mosca.data.frames import Frame


class ReorderBuffer:
    """Frames of ``cameras`` in order of their pulses, at most ``capacity_bytes`` of images."""

    def __init__(self, cameras: Sequence[str], capacity_bytes: int) -> None:
        self._newest = dict.fromkeys(cameras, -1)
        self._heap: list[tuple[int, int, Frame, NumberedBuffer]] = []
        self._order = itertools.count()
        self._bytes, self._capacity = 0, capacity_bytes

    def advance(self, camera: str, pulse: int) -> None:
        """Note the newest pulse of a camera."""
        self._newest[camera] = max(self._newest[camera], pulse)

    def push(self, pulse: int, frame: Frame, buffer: NumberedBuffer) -> None:
        """Insert a frame."""
        heapq.heappush(self._heap, (pulse, next(self._order), frame, buffer))
        self._bytes += 0 if frame.image is None else frame.image.nbytes

    def release(self, active: Collection[str]) -> Iterator[tuple[Frame, NumberedBuffer]]:
        """Yield the frames of the pulses that all ``active`` cameras have reached, and those beyond the capacity."""
        reached = min((self._newest[name] for name in active), default=None)
        while self._heap and (reached is None or self._heap[0][0] <= reached or self._bytes > self._capacity):
            _, _, frame, buffer = heapq.heappop(self._heap)
            self._bytes -= 0 if frame.image is None else frame.image.nbytes
            yield frame, buffer
