"""An entrant: its table in the file, its settings for a data set, and the environment in which it runs."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from mosca.data.files.bounded import parse_json, read_text
from mosca.data.files.toml import Table, check, read_toml
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError

HERE = Path(__file__).parent
ENTRANTS, TUNED, ADAPTERS = HERE / "entrants.toml", HERE / "settings.toml", HERE / "entrants"
BUILD_S = 1200
"""Longest duration of building an environment."""
BoardName = Literal["images", "matched"]


class Entrant(Table):
    """One entrant of ``entrants.toml``."""

    name: str
    title: str
    adapter: str
    tables: tuple[BoardName, ...]
    """``images``: finds points in images by itself; ``matched``: is told which image points are of one marker."""
    note: str = ""
    requirements: tuple[str, ...] = ()
    """What pip installs in its environment; none: this program's own environment."""
    detections_of: str | None = None
    """Whose image points it gets, where it does not detect."""
    settings: dict[str, Any] = Field(default_factory=dict)
    tried: dict[str, list[Any]] = Field(default_factory=dict)
    """Values of settings that were tried on tuning seeds."""


class Entrants(Table):
    """All entrants."""

    entrant: tuple[Entrant, ...]


class EnvironmentFailed(Exception):
    """An environment cannot be built; the message states the reason in one line."""


def read_entrants(names: Sequence[str] = (), path: Path = ENTRANTS) -> tuple[Entrant, ...]:
    """Return all entrants, or those named and those whose image points they get; InputError lists known names."""
    there = {one.name: one for one in check(Entrants, read_toml(path), path).entrant}
    for one in there.values():
        if one.detections_of is not None and one.detections_of not in there:
            raise InputError(
                f"{path}: entrant '{one.name}': detections_of = '{one.detections_of}'; there are {', '.join(there)}"
            )
    for name in names:
        if name not in there:
            raise InputError(f"--entrant {name}: no such entrant; there are {', '.join(there)}")
    wanted = set(names or there)
    wanted |= {other for name in wanted if (other := there[name].detections_of) is not None}
    return tuple(one for one in there.values() if one.name in wanted)


def settings_for(entrant: Entrant, name: str, tuned: Path = TUNED) -> dict[str, Any]:
    """Return an entrant's settings for the set ``name``: tuned ones where there are any, else its own."""
    table = read_toml(tuned) if tuned.is_file() else {}
    found = table.get(entrant.name, {}).get(name, {})
    for key in found:
        if key not in entrant.settings:
            raise InputError(
                f"{tuned}: {entrant.name}.{name}.{key}: no such setting; there are {', '.join(entrant.settings)}"
            )
    return {**entrant.settings, **found}


def python_of(entrant: Entrant, cache: Path) -> Path:
    """Return the Python of an entrant's environment, which is built if it does not exist yet.

    It is below ``cache`` under a digest of its requirements and of this Python's version. EnvironmentFailed where it
    cannot be built; the incomplete environment is removed.
    """
    if not entrant.requirements:
        return Path(sys.executable)
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    key = hashlib.sha256(json.dumps([version, *entrant.requirements]).encode()).hexdigest()[:12]
    folder = cache / "environments" / f"{entrant.name}-{key}"
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if (folder / "installed.json").is_file():
        return python
    shutil.rmtree(folder, ignore_errors=True)
    try:
        venv.create(folder, with_pip=True)
        _called([str(python), "-m", "pip", "install", "-q", "--disable-pip-version-check", *entrant.requirements])
        frozen = _called([str(python), "-m", "pip", "freeze", "--disable-pip-version-check"])
    except (EnvironmentFailed, OSError, subprocess.SubprocessError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise EnvironmentFailed(f"cannot be installed: {_first_line(str(error))}") from None
    write_text(folder / "installed.json", json.dumps(frozen.split(), indent=1) + "\n")
    return python


def installed_versions(python: Path) -> list[str]:
    """Return the packages in an environment built by ``python_of``, in the form of pip freeze; none for our own."""
    path = python.parent.parent / "installed.json"
    found = parse_json(read_text(path, "a list of packages")) if path.is_file() else []
    return [str(one) for one in found]


def own_environment(entrant: Entrant) -> dict[str, str]:
    """Return the environment variables of an entrant's process: one thread, no packages from elsewhere."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    kept |= one | {"PYTHONNOUSERSITE": "1", "PYTHONHASHSEED": "0", "MPLBACKEND": "Agg"}
    if not entrant.requirements:
        kept["PYTHONPATH"] = str(HERE.parents[2])
    return kept


def _called(command: list[str]) -> str:
    """Return the output of a command; EnvironmentFailed with the last line of its error output."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_S, check=False)
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")] or done.stderr.splitlines()
        raise EnvironmentFailed(lines[0] if lines else f"exit code {done.returncode}")
    return done.stdout


def _first_line(text: str) -> str:
    return (text.splitlines() or ["no reason given"])[0][:300]
