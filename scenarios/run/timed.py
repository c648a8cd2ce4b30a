"""Seconds of a run's stages."""

import logging
import time

LOG = logging.getLogger("scenarios.run.scenario")
"""A run's stages are logged under one name."""


class timed:
    """Adds the seconds of a block to a dictionary, and logs them."""

    def __init__(self, timings: dict[str, float], name: str) -> None:
        self._timings, self._name = timings, name

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *exc: object) -> None:
        self._timings[self._name] = time.perf_counter() - self._start
        LOG.info("%s: %.2f s", self._name, self._timings[self._name])
