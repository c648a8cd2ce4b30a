"""A live run: a source that does not wait, and a pipeline with bounded latency.

Frames are read and assembled on a thread of their own, so that no camera's buffer overflows while the pipeline
computes. Frame sets wait in a short queue; when it is full the oldest *whole* set is skipped, counted and named in
the assembly: every set that was assembled is either in the steps or among the skipped. Latency is then bounded by
the queue's length times the time of a set.
"""

import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace

from mosca.data.arrays import Array
from mosca.data.frames import FrameSet, FrameSource
from mosca.data.rig import Rig
from mosca.diagnostics.camera_health import Health
from mosca.diagnostics.sensor import Sensors
from mosca.errors import InputError
from mosca.pipeline import Keeper, PipelineSettings, Step, check_source, run_sets
from mosca.synchronisation import Assembly, AssemblySettings, assemble

LIVE_SPLIT = 2
"""Threads among which the cameras of a frame set are divided, unless the settings set ``split``."""
QUEUED_SETS = 2
"""Frame sets that may wait: one for the pipeline to take, one for the reader to bring."""


class LiveSets:
    """The newest frame sets of a source, in order; iterate once. ``close`` ends the reading thread."""

    def __init__(
        self,
        source: FrameSource,
        assembly: Assembly | None = None,
        queued: int = QUEUED_SETS,
        settings: AssemblySettings | None = None,
    ) -> None:
        if queued < 1:
            raise InputError(f"live: queued = {queued} given; 1 or more frame sets must be able to wait")
        self.assembly = Assembly() if assembly is None else assembly
        self.waited_s = 0.0
        self._source, self._queued, self._settings = source, queued, settings
        self._waiting: deque[tuple[float, FrameSet]] = deque()
        self._changed = threading.Condition()
        self._over, self._stop = False, False
        self._failed: BaseException | None = None
        self._reader = threading.Thread(target=self._read, name="live frames", daemon=True)
        self._reader.start()

    def __iter__(self) -> Iterator[FrameSet]:
        """Yield frame sets until the source ends; ``waited_s`` is how long the last one waited."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._over)
                if not self._waiting:
                    break
                arrived, frame_set = self._waiting.popleft()
            self.waited_s = time.perf_counter() - arrived
            yield frame_set
        if self._failed is not None:
            raise self._failed

    def close(self) -> None:
        """Stop reading and free the source; may be called twice."""
        self._stop = True
        self._source.close()
        self._reader.join()

    def _read(self) -> None:
        try:
            for frame_set in assemble(self._source, self._source.cameras, self._settings, self.assembly):
                if self._stop:
                    break
                self._queue(frame_set)
        except BaseException as error:  # it belongs to the thread that iterates, and is raised there
            self._failed = error
        with self._changed:
            self._over = True
            self._changed.notify()

    def _queue(self, frame_set: FrameSet) -> None:
        with self._changed:
            self._waiting.append((time.perf_counter(), frame_set))
            while len(self._waiting) > self._queued:
                _, left_out = self._waiting.popleft()
                self.assembly.skipped_sets += 1
                self.assembly.notes.setdefault(
                    "skipped",
                    f"frame set {left_out.pulse}: left out whole, the pipeline was {self._queued} sets behind; "
                    "use fewer or smaller frames, or a lower rate",
                )
            self._changed.notify()


def run_live(
    source: FrameSource,
    rig: Rig,
    settings: PipelineSettings | None = None,
    assembly: Assembly | None = None,
    backgrounds: Mapping[str, Array] | None = None,
    keeper: Keeper | None = None,
    health: Health | None = None,
    queued: int = QUEUED_SETS,
    sensors: Sensors | None = None,
) -> Iterator[Step]:
    """Turn a live source's frames into tracks, newest first at need; as ``mosca.pipeline.run``.

    A step's ``seconds`` also contain ``wait``: how long its frame set waited in the queue of ``queued`` sets.
    """
    check_source(source, rig)
    settings = PipelineSettings() if settings is None else settings
    settings = replace(settings, lookahead=0, split=LIVE_SPLIT if settings.split is None else settings.split)
    sets = LiveSets(source, assembly, queued, settings.assembly)
    try:
        for step in run_sets(sets, source.cameras, rig, settings, backgrounds, keeper, health, sensors):
            yield replace(step, seconds={**step.seconds, "wait": sets.waited_s})
    finally:
        sets.close()
