"""Frames of all cameras, pulse by pulse, though one camera's reader is behind the others.

A machine that is held up may run one reader for seconds while another stands. Whoever groups frames waits for a few
pulses only: what comes later, though it was here all the time, is lost to its frame set. So frames wait until every
camera that delivers has come as far; one that was looked at in vain, or is gone, is not waited for.
"""

import heapq
import itertools
from collections.abc import Collection, Iterator, Sequence

from hardware.driver import Grabbed
from mosca.data.frames import Frame


class Abreast:
    """Frames of ``cameras`` that wait for each other, in at most ``room_bytes`` of images."""

    def __init__(self, cameras: Sequence[str], room_bytes: int) -> None:
        self._newest = dict.fromkeys(cameras, -1)
        self._waiting: list[tuple[int, int, Frame, Grabbed]] = []
        self._order = itertools.count()
        self._bytes, self._room = 0, room_bytes

    def reached(self, camera: str, pulse: int) -> None:
        """Note how far a camera has come."""
        self._newest[camera] = max(self._newest[camera], pulse)

    def take(self, pulse: int, frame: Frame, buffer: Grabbed) -> None:
        """Let a frame wait."""
        heapq.heappush(self._waiting, (pulse, next(self._order), frame, buffer))
        self._bytes += 0 if frame.image is None else frame.image.nbytes

    def ready(self, expected: Collection[str]) -> Iterator[tuple[Frame, Grabbed]]:
        """Yield the frames of the pulses that ``expected`` cameras have come to, and what finds no room."""
        far = min((self._newest[name] for name in expected), default=None)
        while self._waiting and (far is None or self._waiting[0][0] <= far or self._bytes > self._room):
            _, _, frame, buffer = heapq.heappop(self._waiting)
            self._bytes -= 0 if frame.image is None else frame.image.nbytes
            yield frame, buffer
