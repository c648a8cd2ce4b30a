"""How a scenario is run: from which frames, on how many threads, what is kept besides."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class RunOptions:
    """How to run.

    ``source``: "twin", "recording:DIR" or "hardware:RIG.toml". ``workers``: threads that render. ``rrd``: a Rerun log
    to write while running. ``record_to``: a folder to record the frames into. ``truth``: what frames that are not
    the twin's are scored against; default: ``truth.npz`` beside a recording. ``progress``: called with pulses done
    and in all.
    """

    source: str = "twin"
    workers: int = 1
    rrd: Path | None = None
    record_to: Path | None = None
    truth: Path | None = None
    progress: Progress | None = None
