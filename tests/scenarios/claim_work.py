"""Stands for a run: a value from the run's own content, at once; some runs fail, or their process dies."""

import hashlib
import os
import time
from pathlib import Path

from scenarios.studies.campaign.worker import RunOutcome


def value_of(task):
    """A value that the run's seed and drawn values decide."""
    digest = hashlib.sha256(repr((task.seed, sorted(task.drawn.items()))).encode()).digest()
    return 1e-4 * (0.5 + digest[0] / 255)


def work(task, contents):
    """Return the value, and a failure of every fortieth run."""
    if task.number % 40 == 39:
        return RunOutcome(task.number, failed="planted")
    return RunOutcome(task.number, {"position_rms": value_of(task)})


def slow_work(task, contents):
    """The same, in a tenth of a second."""
    time.sleep(0.1)
    return work(task, contents)


def dying_work(task, contents):
    """The same; the process of run 5 dies each time, that of run 12 the first time."""
    once = Path(os.environ["CLAIM_TEST_FOLDER"]) / "died"
    if task.number == 5 or (task.number == 12 and not once.exists()):
        if task.number == 12:
            once.touch()
        os._exit(1)
    return work(task, contents)
