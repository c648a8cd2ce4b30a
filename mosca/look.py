"""Looking at frame sets: detection in all cameras, on as many threads as wanted; what it teaches is handed on."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from time import perf_counter

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.detect import DetectionSettings, detect_and_learn
from mosca.refine import NOTHING, Learned

BEHIND = 4
"""Frame sets after which what one taught is used: however many threads look ahead, each set is looked at with the
same knowledge, and gives the same detections.
"""

QUICK, SELDOM = 64, 16
"""Up to this set all is used at once; after it, when little is new, so many sets' lessons at a time."""

Seen = tuple[dict[str, Detections], Learned, float]


@dataclass(frozen=True)
class Look:
    """How frames are looked at: settings, each camera's ``bit_depth`` and what is taken off its images."""

    settings: DetectionSettings
    bit_depth: Mapping[str, int]
    backgrounds: Mapping[str, Array] = field(default_factory=dict)

    def at(self, frame_set: FrameSet, learned: Learned) -> Seen:
        """Return the detections of a set's cameras, what they teach, and the time that it took [s]."""
        start = perf_counter()
        detections: dict[str, Detections] = {}
        taught = NOTHING
        images = {name: f.image for name, f in frame_set.frames.items() if f.image is not None}
        for depth in sorted({self.bit_depth[name] for name in images}):
            names = [name for name in images if self.bit_depth[name] == depth]
            backgrounds = [self.backgrounds.get(name) for name in names] if self.backgrounds else None
            found, new = detect_and_learn(
                [images[name] for name in names], names, self.settings, depth, backgrounds, None, learned
            )
            detections.update(zip(names, found, strict=True))
            taught = taught.plus(new)
        return {name: detections[name] for name in images}, taught, perf_counter() - start


def look_ahead(
    look: Look, sets: Iterable[FrameSet], workers: int
) -> Iterator[tuple[FrameSet, dict[str, Detections], float]]:
    """Yield each frame set with its detections and the computing time that they took [s], in order.

    ``workers``: threads that look at sets ahead of the one that is yielded; 0: at each in its turn.
    """
    known = _Known()
    if workers <= 0:
        for number, frame_set in enumerate(sets):
            detections, taught, seconds = look.at(frame_set, known.at(number))
            known.add(taught)
            yield frame_set, detections, seconds
        return
    waiting: deque[tuple[FrameSet, Future[Seen]]] = deque()

    def first() -> tuple[FrameSet, dict[str, Detections], float]:
        frame_set, future = waiting.popleft()
        detections, taught, seconds = future.result()
        known.add(taught)
        return frame_set, detections, seconds

    with ThreadPoolExecutor(workers, "look") as pool:
        try:
            for number, frame_set in enumerate(sets):
                waiting.append((frame_set, pool.submit(look.at, frame_set, known.at(number))))
                if len(waiting) >= min(workers + 1, BEHIND):
                    yield first()
            while waiting:
                yield first()
        finally:
            for _, future in waiting:
                future.cancel()


class _Known:
    """What the sets up to BEHIND before a set have taught."""

    def __init__(self) -> None:
        self._learned, self._used = NOTHING, 0
        self._lessons: deque[Learned] = deque()

    def add(self, taught: Learned) -> None:
        """Take what the next set has taught."""
        self._lessons.append(taught)

    def at(self, number: int) -> Learned:
        """Return what is known when set ``number`` is looked at; numbers rise."""
        behind = number - BEHIND
        if number >= QUICK:
            behind -= number % SELDOM
        while self._used <= behind:
            self._learned = self._learned.plus(self._lessons.popleft())
            self._used += 1
        return self._learned
