"""Detection for all cameras, in threads; per-camera estimates of blur and bias are used for later frame sets."""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import accumulate, chain, groupby, pairwise
from time import perf_counter

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import FrameSet
from mosca.detection.detect import DetectionSettings, detect_with_statistics
from mosca.detection.disc_fit.camera_statistics import NO_STATISTICS, CameraStatistics, joined, summed

DELAY = 4
"""Frame sets after which a set's statistics are used: with any number of threads, each set is detected with the same
estimates, and gives the same detections."""

EARLY_SETS, UPDATE_PERIOD = 64, 16
"""Up to this set the estimates are updated at the ``EARLY_UPDATES``. After it they are updated once in every so many
sets, each camera's at a different one."""
EARLY_UPDATES = tuple(accumulate([0] + 8 * [1] + 4 * [2] + 3 * [3] + 3 * [4] + 3 * [6] + [8]))
"""Update schedule: every set at first, then when the data grew by about 12 %; the solve costs more than a set."""

REFRESH_PERIOD = 128
"""Each camera's background is measured once in every so many sets: lamps warm up and daylight moves more slowly."""

TEXTURED_PERIOD = 16
"""As ``REFRESH_PERIOD``, for a textured background: targets uncover it pixel by pixel."""
LOOK_SETS, FEWEST_SETS, LOOK_BYTES = 16, 8, 2**28
"""Largest number of the sets read ahead that are looked at, evenly spaced so that targets move between them. Of fewer
sets than the second number none is looked at: slow targets would be taken for background. The third is the largest
size of all sets that are read ahead [bytes]."""

Detected = tuple[dict[str, Detections], CameraStatistics, float]
"""Detections by camera, what the set adds to the cameras' statistics, and computing time [s]."""

Attend = Callable[[FrameSet, Mapping[str, Detections], CameraStatistics], None]
"""Called with a set, its detections and what it adds to the cameras' statistics."""


def _nobody(frame_set: FrameSet, detections: Mapping[str, Detections], added: CameraStatistics) -> None:
    """Attend to nothing."""


def _phase(camera: str) -> int:
    """Return a camera's phase in the updates: cameras whose names count up differ in it, which spreads the cost."""
    return sum(camera.encode())


@dataclass(frozen=True)
class FrameSetDetector:
    """Detection in the images of frame sets."""

    settings: DetectionSettings
    bit_depth: Mapping[str, int]
    """Significant bits of each camera's pixels."""
    backgrounds: Mapping[str, Array] = field(default_factory=dict)
    """Images (H, W) that are subtracted, by camera."""

    def detect(
        self,
        frame_set: FrameSet,
        statistics: CameraStatistics,
        helpers: Executor | None = None,
        split: int = 1,
        measures_all: bool = False,
    ) -> Detected:
        """Return the detections of a set's cameras, what they add to the statistics, and the computing time [s].

        ``statistics``: of earlier sets; ``split``: number of shares into which the cameras are divided, all but the
        first for the ``helpers``; ``measures_all``: all cameras' backgrounds are measured, not only those that are
        due.
        """
        start = perf_counter()
        images = {name: f.image for name, f in frame_set.frames.items() if f.image is not None}
        names = list(images)
        shares = max(1, min(split if helpers is not None else 1, len(names)))
        bounds = [len(names) * k // shares for k in range(shares + 1)]
        own, *others = [{n: images[n] for n in names[i:j]} for i, j in pairwise(bounds)]
        again = [name for name in names if measures_all or self._is_due(name, frame_set.pulse, statistics)]
        pending = [helpers.submit(self._some, share, statistics, again) for share in others] if helpers else []
        detections, added = self._some(own, statistics, again)
        for future in pending:
            found, new = future.result()
            detections.update(found)
            added = added.plus(new)
        return {name: detections[name] for name in names}, added, perf_counter() - start

    def _is_due(self, name: str, pulse: int, statistics: CameraStatistics) -> bool:
        """Return whether a camera's background is measured again."""
        known = statistics.backgrounds.get(name)
        if known is None or not self._learns_pixels(name) or not known.textured:
            return (pulse + _phase(name)) % REFRESH_PERIOD == 0
        return known.wants_images or (pulse + _phase(name)) % TEXTURED_PERIOD == 0

    def _learns_pixels(self, name: str) -> bool:
        """Return whether the background of a camera's pixels is learned where it is textured."""
        return self.settings.thresholds == "noise" and name not in self.backgrounds

    def is_textured(self, learned: CameraStatistics) -> bool:
        """Return whether some camera's background is textured and learned pixel by pixel."""
        return any(own.textured for name, own in learned.backgrounds.items() if self._learns_pixels(name))

    def _some(
        self, images: Mapping[str, Array], statistics: CameraStatistics, refresh: Collection[str]
    ) -> tuple[dict[str, Detections], CameraStatistics]:
        """Return the detections of some cameras' images and what they add to the statistics."""
        detections: dict[str, Detections] = {}
        added = NO_STATISTICS
        for depth in sorted({self.bit_depth[name] for name in images}):
            names = [name for name in images if self.bit_depth[name] == depth]
            backgrounds = [self.backgrounds.get(name) for name in names] if self.backgrounds else None
            found, new = detect_with_statistics(
                [images[name] for name in names], names, self.settings, depth, backgrounds, statistics, refresh
            )
            detections.update(zip(names, found, strict=True))
            added = added.plus(new)
        return detections, added


def detect_ahead(
    detector: FrameSetDetector,
    sets: Iterable[FrameSet],
    workers: int,
    split: int = 1,
    attend: Attend | None = None,
    lookahead: int = 0,
) -> Iterator[tuple[FrameSet, dict[str, Detections], float]]:
    """Yield each frame set with its detections and the computing time that they took [s], in order.

    ``workers``: threads that detect in sets ahead of the one that is yielded. The caller's own thread works on a set
    itself rather than wait. 0: one set after the other, its cameras divided among ``split`` threads. ``attend`` is
    called with each set, its detections and what it adds to the statistics, in order. ``lookahead``: number of sets
    that are read before the first one is yielded, to learn from some of them.
    """
    attend = attend or _nobody
    if workers <= 0:
        yield from _one_by_one(detector, sets, split, attend, lookahead)
        return
    queue: deque[_Ahead] = deque()

    def first() -> tuple[FrameSet, dict[str, Detections], float]:
        detections, added, seconds = _await_first(queue)
        delayed.add(added)
        frame_set = queue.popleft().frame_set
        attend(frame_set, detections, added)
        return frame_set, detections, seconds

    with ThreadPoolExecutor(workers, "detect") as pool:
        sets, known = _first_look(detector, sets, lookahead, pool, workers + 1)
        delayed = _DelayedSums(known)
        try:
            for number, frame_set in enumerate(sets):
                used = delayed.for_frame_set(number)
                detect = partial(detector.detect, frame_set, used, measures_all=_records(detector, number, used))
                queue.append(_Ahead(frame_set, detect, pool.submit(detect)))
                if len(queue) >= min(workers + 2, DELAY):
                    yield first()
            while queue:
                yield first()
        finally:
            for ahead in queue:
                ahead.future.cancel()


def _first_look(
    detector: FrameSetDetector, sets: Iterable[FrameSet], lookahead: int, helpers: Executor | None, split: int
) -> tuple[Iterator[FrameSet], CameraStatistics]:
    """Return all of the sets, and what is learned from the first of them.

    Where backgrounds are textured, these sets are looked at twice: targets that the texture hid the first time do not
    vote the second time.
    """
    left, seen, learned, most = iter(sets), list[FrameSet](), NO_STATISTICS, lookahead
    for frame_set in left if lookahead > 0 else ():
        seen.append(frame_set)
        most = min(most, most_ahead(frame_set))
        if len(seen) >= most:
            break
    looked_at = seen[:: -(-len(seen) // LOOK_SETS)] if len(seen) >= FEWEST_SETS else []
    for frame_set in looked_at:
        learned = learned.plus(detector.detect(frame_set, learned, helpers, split)[1])
    if detector.is_textured(learned):
        known, learned = learned, NO_STATISTICS
        for frame_set in looked_at:
            learned = learned.plus(detector.detect(frame_set, known, helpers, split, measures_all=True)[1])
    return chain(seen, left), learned


def _records(detector: FrameSetDetector, number: int, used: CameraStatistics) -> bool:
    """Return whether set ``number`` measures all backgrounds: the first, for the run's record of even backgrounds.

    On the pixels of a textured background it would be a second vote of one image.
    """
    return number == 0 and not detector.is_textured(used)


def most_ahead(frame_set: FrameSet) -> int:
    """Return how many sets of this size may be held in memory."""
    size = sum(f.image.nbytes for f in frame_set.frames.values() if f.image is not None)
    return LOOK_BYTES // max(size, 1)


@dataclass
class _Ahead:
    """A frame set whose detection is under way."""

    frame_set: FrameSet
    detect: Callable[[], Detected]
    future: Future[Detected]


def _await_first(queue: Sequence[_Ahead]) -> Detected:
    """Return the detections of the first set of the queue; until then work on those that no thread has begun."""
    first = queue[0]
    for ahead in queue:
        if first.future.done():
            break
        if ahead.future.cancel():  # no thread has begun it
            ahead.future = Future()
            try:
                ahead.future.set_result(ahead.detect())
            except Exception as error:  # raised when this set is yielded
                ahead.future.set_exception(error)
    return first.future.result()


def _one_by_one(
    detector: FrameSetDetector, sets: Iterable[FrameSet], split: int, attend: Attend, lookahead: int
) -> Iterator[tuple[FrameSet, dict[str, Detections], float]]:
    with ExitStack() as stack:
        helpers = stack.enter_context(ThreadPoolExecutor(split - 1, "detect")) if split > 1 else None
        sets, known = _first_look(detector, sets, lookahead, helpers, split)
        delayed = _DelayedSums(known)
        used = delayed.for_frame_set(0)
        for number, frame_set in enumerate(sets):
            measures_all = _records(detector, number, used)
            detections, added, seconds = detector.detect(frame_set, used, helpers, split, measures_all)
            yield frame_set, detections, seconds
            # off the latency path: the solve takes long
            delayed.add(added)
            attend(frame_set, detections, added)
            used = delayed.for_frame_set(number + 1)
            used.solve()


class DelayedStatistics:
    """One camera's statistics: those of a set are added after ``DELAY`` sets and used from the next update on.

    Until then, those of a first look (``known``) are used, also while the sets so far showed fewer targets.
    """

    def __init__(self, camera: str, known: CameraStatistics = NO_STATISTICS) -> None:
        self._camera, self._phase = camera, _phase(camera) % UPDATE_PERIOD
        self._known = self._used = known
        self._summed = known.backgrounds_alone()
        self._pending: deque[tuple[int, CameraStatistics]] = deque()
        self._updated = -1

    def add(self, number: int, added: CameraStatistics) -> None:
        """Take what set ``number`` adds, of this camera and maybe others; numbers rise."""
        self._pending.append((number, added))

    def for_frame_set(self, number: int) -> CameraStatistics:
        """Return the statistics that detection in set ``number`` uses; numbers rise."""
        if number < EARLY_SETS:
            update = EARLY_UPDATES[bisect_right(EARLY_UPDATES, number) - 1]
        else:
            update = max(number - (number - self._phase) % UPDATE_PERIOD, EARLY_UPDATES[-1])
        if update > self._updated:
            due = list[tuple[int, CameraStatistics]]()
            while self._pending and self._pending[0][0] <= update - DELAY:
                due.append(self._pending.popleft())
            # one sum for each update, also for those at which nobody asked
            for _, group in groupby(due, lambda one: self._first_use(one[0])):
                new = summed(self._camera, [added for _, added in group])
                self._summed = self._summed.plus(new) if new.names else self._summed
            enough = self._summed.targets() >= self._known.targets()
            self._updated, self._used = update, self._summed if enough else self._known
        return self._used

    def _first_use(self, number: int) -> int:
        """Return the first update at which what set ``number`` adds is used."""
        earliest = number + DELAY
        if earliest <= EARLY_UPDATES[-1]:
            return EARLY_UPDATES[bisect_left(EARLY_UPDATES, earliest)]
        return earliest + (self._phase - earliest) % UPDATE_PERIOD


class _DelayedSums:
    """All cameras' delayed statistics."""

    def __init__(self, known: CameraStatistics) -> None:
        self._cameras = {name: DelayedStatistics(name, own) for name, own in known.by_camera().items()}
        self._parts: dict[str, CameraStatistics] = {}
        self._number, self._used = 0, NO_STATISTICS

    def add(self, added: CameraStatistics) -> None:
        """Take what the next set adds."""
        for name in added.names:
            if name not in self._cameras:
                self._cameras[name] = DelayedStatistics(name)
            self._cameras[name].add(self._number, added)
        self._number += 1

    def for_frame_set(self, number: int) -> CameraStatistics:
        """Return the statistics that detection in set ``number`` uses; numbers rise."""
        parts = {name: own.for_frame_set(number) for name, own in self._cameras.items()}
        if any(one is not self._parts.get(name) for name, one in parts.items()):
            self._parts, self._used = parts, joined(parts)
        return self._used
