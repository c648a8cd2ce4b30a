"""Seconds of a run's stages."""

import logging
import time
from collections.abc import Callable

LOG = logging.getLogger("scenarios.run.scenario")
"""The stages of a run are logged under one name."""


class StageTimes(dict[str, float]):
    """Seconds by stage; ``tell`` is called with the name of each stage that begins."""

    def __init__(self, tell: Callable[[str], None] | None = None) -> None:
        super().__init__()
        self.tell = tell


class timed:
    """Adds the seconds of a block to a dictionary, and logs them."""

    def __init__(self, timings: dict[str, float], name: str) -> None:
        self._timings, self._name = timings, name

    def __enter__(self) -> None:
        if isinstance(self._timings, StageTimes) and self._timings.tell is not None:
            self._timings.tell(self._name.replace("_", " "))
        self._start = time.perf_counter()

    def __exit__(self, *exc: object) -> None:
        self._timings[self._name] = time.perf_counter() - self._start
        LOG.info("%s: %.2f s", self._name, self._timings[self._name])
