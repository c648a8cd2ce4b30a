"""Looking at frame sets: detection in all cameras, on as many threads as wanted; what it teaches is handed on."""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from time import perf_counter

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.detection.detect import DetectionSettings, detect_with_statistics
from mosca.detection.disc_fit.camera_statistics import NO_STATISTICS, CameraStatistics, joined

BEHIND = 4
"""Frame sets after which what one taught is used: however many threads look ahead, each set is looked at with the
same knowledge, and gives the same detections.
"""

QUICK, SELDOM = 64, 16
"""Up to this set what is new is used at the ``EARLY`` sets; after it, when little is new, so many sets' lessons at a
time, each camera's at other sets."""
EARLY = tuple(accumulate([0] + 8 * [1] + 4 * [2] + 3 * [3] + 3 * [4] + 3 * [6] + [8]))
"""All at first, then when about an eighth is new: to draw the conclusions takes longer than to look at a set."""

Seen = tuple[dict[str, Detections], CameraStatistics, float]


@dataclass(frozen=True)
class FrameSetDetector:
    """How frames are looked at: settings, each camera's ``bit_depth`` and what is taken off its images."""

    settings: DetectionSettings
    bit_depth: Mapping[str, int]
    backgrounds: Mapping[str, Array] = field(default_factory=dict)

    def detect(
        self, frame_set: FrameSet, learned: CameraStatistics, helpers: Executor | None = None, split: int = 1
    ) -> Seen:
        """Return the detections of a set's cameras, what they teach, and the time that it took [s].

        ``split``: the cameras are divided into so many shares; all but the first go to the ``helpers``.
        """
        start = perf_counter()
        images = {name: f.image for name, f in frame_set.frames.items() if f.image is not None}
        names = list(images)
        shares = max(1, min(split if helpers is not None else 1, len(names)))
        bounds = [len(names) * k // shares for k in range(shares + 1)]
        own, *others = [{n: images[n] for n in names[i:j]} for i, j in pairwise(bounds)]
        waiting = (
            [helpers.submit(self._some, share, learned) for share in others] if helpers is not None else []
        )
        detections, taught = self._some(own, learned)
        for future in waiting:
            found, new = future.result()
            detections.update(found)
            taught = taught.plus(new)
        return {name: detections[name] for name in names}, taught, perf_counter() - start

    def _some(
        self, images: Mapping[str, Array], learned: CameraStatistics
    ) -> tuple[dict[str, Detections], CameraStatistics]:
        """Return the detections of some cameras' images and what they teach."""
        detections: dict[str, Detections] = {}
        taught = NO_STATISTICS
        for depth in sorted({self.bit_depth[name] for name in images}):
            names = [name for name in images if self.bit_depth[name] == depth]
            backgrounds = [self.backgrounds.get(name) for name in names] if self.backgrounds else None
            found, new = detect_with_statistics(
                [images[name] for name in names], names, self.settings, depth, backgrounds, None, learned
            )
            detections.update(zip(names, found, strict=True))
            taught = taught.plus(new)
        return detections, taught


def detect_ahead(
    look: FrameSetDetector, sets: Iterable[FrameSet], workers: int, split: int = 1
) -> Iterator[tuple[FrameSet, dict[str, Detections], float]]:
    """Yield each frame set with its detections and the computing time that they took [s], in order.

    ``workers``: threads that look at sets ahead of the one that is yielded, beside the caller's own, which looks at
    one itself rather than wait; 0: at each in its turn, its cameras divided among ``split`` threads.
    """
    if workers <= 0:
        yield from _look_in_turn(look, sets, split)
        return
    known = _Known()
    waiting: deque[_Ahead] = deque()

    def first() -> tuple[FrameSet, dict[str, Detections], float]:
        detections, taught, seconds = _while_waiting(look, waiting)
        known.add(taught)
        return waiting.popleft().frame_set, detections, seconds

    with ThreadPoolExecutor(workers, "look") as pool:
        try:
            for number, frame_set in enumerate(sets):
                learned = known.for_frame_set(number)
                waiting.append(_Ahead(frame_set, learned, pool.submit(look.detect, frame_set, learned)))
                if len(waiting) >= min(workers + 2, BEHIND):
                    yield first()
            while waiting:
                yield first()
        finally:
            for ahead in waiting:
                ahead.future.cancel()


@dataclass
class _Ahead:
    """A frame set that is looked at ahead, with what is known for it."""

    frame_set: FrameSet
    learned: CameraStatistics
    future: Future[Seen]


def _while_waiting(look: FrameSetDetector, waiting: Sequence[_Ahead]) -> Seen:
    """Return what is seen in the first set that waits; until then look at those that no thread has begun."""
    first = waiting[0]
    for ahead in waiting:
        if first.future.done():
            break
        if ahead.future.cancel():  # it is ours now
            ahead.future = Future()
            try:
                ahead.future.set_result(look.detect(ahead.frame_set, ahead.learned))
            except Exception as error:  # raised when it is this set's turn
                ahead.future.set_exception(error)
    return first.future.result()


def _look_in_turn(
    look: FrameSetDetector, sets: Iterable[FrameSet], split: int
) -> Iterator[tuple[FrameSet, dict[str, Detections], float]]:
    known = _Known()
    with ExitStack() as stack:
        helpers = stack.enter_context(ThreadPoolExecutor(split - 1, "look")) if split > 1 else None
        learned = known.for_frame_set(0)
        for number, frame_set in enumerate(sets):
            detections, taught, seconds = look.detect(frame_set, learned, helpers, split)
            yield frame_set, detections, seconds
            # while the next set is on its way: to conclude takes long
            known.add(taught)
            learned = known.for_frame_set(number + 1)
            learned.conclude()


class DelayedStatistics:
    """What one camera's sets have taught: added up as it falls due, and the sum used at the camera's turns."""

    def __init__(self, camera: str) -> None:
        # cameras that are numbered on have turns one after the other: no set pays for all
        self._phase = sum(camera.encode()) % SELDOM
        self._learned = self._gathered = NO_STATISTICS
        self._waiting: deque[tuple[int, CameraStatistics]] = deque()
        self._turn = -1

    def add(self, number: int, taught: CameraStatistics) -> None:
        """Take what set ``number`` has taught; numbers rise."""
        self._waiting.append((number, taught))

    def for_frame_set(self, number: int) -> CameraStatistics:
        """Return what is known when set ``number`` is looked at; numbers rise."""
        if number < QUICK:
            turn = EARLY[bisect_right(EARLY, number) - 1]
        else:
            turn = max(number - (number - self._phase) % SELDOM, EARLY[-1])
        if turn > self._turn:
            self._gather(turn - BEHIND)
            self._turn, self._learned = turn, self._gathered
        return self._learned

    def _gather(self, last: int) -> None:
        while self._waiting and self._waiting[0][0] <= last:
            self._gathered = self._gathered.plus(self._waiting.popleft()[1])


class _Known:
    """What the sets up to BEHIND before a set have taught, camera by camera."""

    def __init__(self) -> None:
        self._cameras: dict[str, DelayedStatistics] = {}
        self._parts: dict[str, CameraStatistics] = {}
        self._number, self._learned = 0, NO_STATISTICS

    def add(self, taught: CameraStatistics) -> None:
        """Take what the next set has taught."""
        for name, lesson in taught.each().items():
            if name not in self._cameras:
                self._cameras[name] = DelayedStatistics(name)
            self._cameras[name].add(self._number, lesson)
        self._number += 1

    def for_frame_set(self, number: int) -> CameraStatistics:
        """Return what is known when set ``number`` is looked at; numbers rise."""
        parts = {name: lessons.for_frame_set(number) for name, lessons in self._cameras.items()}
        if any(one is not self._parts.get(name) for name, one in parts.items()):
            self._parts, self._learned = parts, joined(parts)
        return self._learned
