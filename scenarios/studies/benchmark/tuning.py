"""Settings of the entrants in ``settings.toml``, tuned on seeds that are not held out.

Each data set is tuned separately, so that no peer is held back by the needs of another set. The values that
``entrants.toml`` lists are tried one after the other, with other settings held, and the value with the least OSPA is
kept. An entrant that finds points in images by itself is tuned on that. mosca has no settings here: it runs with its
defaults.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from mosca.data.files.toml import read_toml
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError
from scenarios.studies.benchmark.benchmark import BenchmarkJob, OnSet
from scenarios.studies.benchmark.entrant import TUNED, Entrant, EnvironmentFailed, python_of
from scenarios.studies.benchmark.make import SetFile, make_set, missing
from scenarios.studies.benchmark.seeds import tuning

FRAMES = 6
"""Number of frames of each set for tuning."""
HEAD = (
    "# Made by 'mosca benchmark --tune' on the tuning seeds, of which nothing is scored: for each entrant and set\n"
    "# the settings with the least OSPA (scenarios/studies/benchmark/tuning.py); for a key that is missing see\n"
    "# entrants.toml.\n"
)


def tune(
    sets: Sequence[SetFile],
    entrants: Sequence[Entrant],
    job: BenchmarkJob,
    shown: Callable[[str], object],
    out: Path = TUNED,
) -> None:
    """Tune the entrants on the sets and write ``out``, where other entries stay; InputError where one cannot run."""
    pythons = {}
    for entrant in entrants:
        try:
            pythons[entrant.name] = python_of(entrant, job.cache)
        except EnvironmentFailed as error:
            raise InputError(f"--tune: {entrant.name} {error}; tune where all entrants can be installed") from None
    for one in sets:
        if why := missing(one):
            raise InputError(f"--tune: {one.name}: {why}")
        make_set(one, tuning(), job.data, job.workers, FRAMES)
        on_set = OnSet(one.name, job, pythons, {})
        tuned = {}
        for entrant in entrants:
            if entrant.tried or entrant.name in {e.detections_of for e in entrants}:
                best, found = _best(on_set, entrant)
                changed = {key: value for key, value in best.items() if value != entrant.settings.get(key)}
                tuned[entrant.name] = changed
                shown(f"{one.name}: {entrant.name}: OSPA {1e3 * found:.4g} mm with {best}")
        # read again, since sets may be tuned in parallel
        table = read_toml(out) if out.is_file() else {}
        for name, changed in tuned.items():
            table.setdefault(name, {})[one.name] = changed
        write_text(out, HEAD + tomli_w.dumps(table))


def _best(on_set: OnSet, entrant: Entrant) -> tuple[dict[str, Any], float]:
    """Return the settings with the least OSPA [m] on a set, and this OSPA."""
    board = entrant.tables[0]

    def found(settings: dict[str, Any]) -> float:
        return on_set.scored(entrant, board, settings, "first")[0]["ospa"].value

    best = dict(entrant.settings)
    least = found(best)
    for key, values in entrant.tried.items():
        for value in values:
            settings = best | {key: value}
            if value != entrant.settings[key] and (now := found(settings)) < least:
                best, least = settings, now
    # other entrants get the image points of the best settings
    return best, found(best)
