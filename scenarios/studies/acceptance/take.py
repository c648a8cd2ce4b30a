"""The tracks of an acceptance test, from a scenario's run, a take, or a recording that is reconstructed."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mosca.accuracy.acceptance.artefact import AcceptanceFile, read_acceptance
from mosca.accuracy.acceptance.latency import ResultArrivals, read_arrivals
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.tracks.tracks_file import SUFFIXES, read_tracks
from scenarios.build.scene import beside
from scenarios.commands.reconstruct import reconstruct_recording
from scenarios.run.postprocess import Postprocessing
from scenarios.run.scenario import run_scenario
from scenarios.run.take_files import TRACKS_FILES
from scenarios.spec.catalog import find, scenario_name
from scenarios.spec.scenario import load_scenario
from scenarios.studies.campaign.files import gathered
from scenarios.types import RunOptions

ARRIVALS_FILE = "arrivals.csv"
Told = Callable[[int, int | None], None]


@dataclass(frozen=True)
class AcceptOptions:
    """The options of ``mosca accept``, under their names; ``what``: scenario, run folder, tracks or recording."""

    what: str
    artefact: Path | None = None
    rig: Path | None = None
    fps: float | None = None
    source: str | None = None
    seed: int | None = None
    overrides: tuple[str, ...] = ()
    arrivals: Path | None = None
    workers: int | None = None


@dataclass(frozen=True, eq=False)
class Take:
    """Tracks with the acceptance file that tests them."""

    name: str
    """Name on the page."""
    source: str
    """"twin", "recording", "rig" or "tracks", and its name."""
    tracks: Tracks
    given: AcceptanceFile
    files: tuple[tuple[str, Path], ...]
    """Input files: role and path of each."""
    arrivals: ResultArrivals | None
    notes: tuple[str, ...] = ()


def take_of(options: AcceptOptions, out: Path, told: Told) -> Take:
    """Return the take named by ``options``; a recording's tracks go into ``out``. InputError for wrong inputs."""
    path = Path(options.what)
    if path.is_dir() or path.suffix.lower() in SUFFIXES:
        tracks = next((path / n for n in TRACKS_FILES if (path / n).is_file()), None) if path.is_dir() else path
        _without(options, ("source", "seed"), f"{path}: is no scenario")
        return (
            _measured_take(options, path, tracks) if tracks is not None else _recorded_take(options, path, out, told)
        )
    _without(options, ("artefact", "rig", "fps"), f"{options.what}: a scenario names its own artefact and cameras")
    return _scenario_take(options, told)


def _scenario_take(options: AcceptOptions, told: Told) -> Take:
    path = find(options.what)
    overrides = options.overrides if options.seed is None else (*options.overrides, f"seed={options.seed}")
    spec, name = load_scenario(path, overrides), scenario_name(path)
    if spec.acceptance is None:
        raise InputError(f"{path}: no [acceptance] in it; add one with the acceptance file: file = 'bar.acceptance'")
    own = beside(spec.acceptance.file, path.parent)
    given = read_acceptance(own)
    source = options.source or "twin"
    workers = options.workers or os.cpu_count() or 1
    made = run_scenario(spec, name, path.parent, RunOptions(source, workers, progress=told, page=False))
    files = [("scenario", path)]
    named = gathered(spec.model_dump(mode="json"), path.parent)
    root = path.parent.resolve().parents[len(Path(named.folder).parts) - 1] if named.folder != "." else path.parent
    files += [("file of the scenario", root / place) for place in named.digests]
    kind, _, where = source.partition(":")
    files += {"recording": [("recording", Path(where))], "hardware": [("rig", Path(where))]}.get(kind, [])
    words = {"twin": "twin", "recording": f"recording {where}", "hardware": f"rig {where}"}[kind]
    changed = tuple(f"changed from the scenario's file: {one}" for one in overrides)
    return Take(name, words, made.tracks, given, tuple(files), _arrivals(options, None), changed)


def _measured_take(options: AcceptOptions, path: Path, tracks: Path) -> Take:
    _without(options, ("rig", "fps"), f"{path}: holds tracks already")
    if options.overrides:
        raise InputError(f"--set {options.overrides[0]}: {path} holds tracks already; leave it out")
    artefact = _artefact(options, path)
    folder = path if path.is_dir() else None
    given = read_acceptance(artefact)
    files = (("acceptance file", artefact), ("tracks", tracks))
    return Take(str(path), f"tracks {tracks}", read_tracks(tracks), given, files, _arrivals(options, folder))


def _recorded_take(options: AcceptOptions, path: Path, out: Path, told: Told) -> Take:
    artefact = _artefact(options, path)
    given = read_acceptance(artefact)
    rig = options.rig or path / "rig.toml"
    if not rig.is_file():
        raise InputError(
            f"{path}: holds no tracks and no rig.toml; give the rig it was recorded with: --rig RIG.toml"
        )
    out.mkdir(parents=True, exist_ok=True)
    tracks = out / TRACKS_FILES[0]
    after = Postprocessing(None, None, None)
    lines = reconstruct_recording(path, rig, tracks, options.fps, None, options.overrides, told, after)
    files = (("acceptance file", artefact), ("rig", rig), ("tracks", tracks), ("recording", path))
    found = read_tracks(tracks)
    return Take(str(path), f"recording {path}", found, given, files, _arrivals(options, path), tuple(lines))


def _artefact(options: AcceptOptions, path: Path) -> Path:
    if options.artefact is None:
        raise InputError(
            f"{path}: which markers make which certified length is not known; give the acceptance file: "
            "--artefact BAR.acceptance"
        )
    return options.artefact


def _arrivals(options: AcceptOptions, folder: Path | None) -> ResultArrivals | None:
    path = options.arrivals
    if path is None and folder is not None and (folder / ARRIVALS_FILE).is_file():
        path = folder / ARRIVALS_FILE
    return None if path is None else read_arrivals(path)


def _without(options: AcceptOptions, names: tuple[str, ...], reason: str) -> None:
    for name in names:
        if getattr(options, name) is not None:
            raise InputError(f"--{name} {getattr(options, name)}: {reason}; leave it out")
