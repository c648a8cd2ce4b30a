"""The run folder: tested before a long run, and written with all files that can be written."""

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mosca.data.files.rig_file import write_rig
from mosca.data.files.whole_file import check_folder, check_own_folder, whole_file, write_text
from mosca.data.tracks import write_npz
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import write_bodies_csv
from mosca.formats.tracks.tracks_csv import write_tracks_csv
from mosca.machines.identification.model_file import write_model
from reports.calibration_page import write_calibration_page
from reports.page import write_page
from reports.record import write_record
from scenarios.run.flight import flight_files
from scenarios.run.kept_budgets import kept_budget
from scenarios.run.scenario import RunResult
from scenarios.run.take_files import POSES_FILE, RECORD_FILE, RIG_FILE, TRACKS_FILES
from scenarios.run.vibration import vibration_files


def check_out(out: Path) -> None:
    """Raise InputError where ``out`` cannot become a run folder; to be called before a long run."""
    check_own_folder(out, RECORD_FILE)
    # an earlier run folder is replaced by a new one made beside it
    check_folder(out.parent)


def write_run(result: RunResult, out: Path, rrd: Path | None = None) -> None:
    """Write the run folder: the record first, the pages last; it appears after all files were tried.

    An earlier run folder there is replaced. Where a file cannot be written, the others still are; InputError then
    names the files that exist, those that do not, and the reason. Without its record there is no run folder, and an
    earlier one stays.
    """
    check_out(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        part = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}."))
    except OSError as error:
        raise InputError(f"{out}: not written: {error.strerror}; make room, or choose another place") from None
    failed: dict[str, Exception] = {}
    try:
        for name, write in _files(result, rrd).items():
            try:
                write(part / name)
            except Exception as error:  # kept, and raised below
                failed[name] = error
        if RECORD_FILE not in failed:
            part.chmod(0o755)
            if out.exists():
                shutil.rmtree(out)
            os.replace(part, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    _raise_failed(failed, out)


def _files(result: RunResult, rrd: Path | None) -> dict[str, Callable[[Path], object]]:
    """Return name of each file of a run folder -> function that writes it; files that cannot be remade come first."""
    own = result.calibration
    files: dict[str, Callable[[Path], object] | None] = {
        RECORD_FILE: lambda path: write_record(result.record, path),
        TRACKS_FILES[0]: lambda path: _write_tracks(result, path),
        TRACKS_FILES[1]: lambda path: write_tracks_csv(result.tracks, path),
        POSES_FILE: None if (poses := result.poses) is None else lambda path: write_bodies_csv(poses, path),
        "commands.csv": None if result.commands is None else lambda path: _write_commands(result.commands, path),
        **({} if result.person is None else result.person.files()),
        **({} if result.vibration is None else vibration_files(result.vibration)),
        **({} if result.flight is None else flight_files(result.flight)),
        "model.json": None if (model := result.model) is None else lambda path: write_model(model, path),
        # a refused calibration has only its page, which states the reason; it cannot be used to measure
        RIG_FILE: None
        if own is None or own.calibration.refused
        else lambda path: write_rig(own.calibration.rig, path),
        "run.rrd": None if rrd is None else lambda path: shutil.move(rrd, path),
        "report.html": lambda path: write_page(path, result.record, result.evidence, kept_budget(result.record)),
        "calibration.html": None
        if own is None
        else lambda path: write_calibration_page(path, own.calibration, own.evidence),
    }
    return {name: write for name, write in files.items() if write is not None}


def _raise_failed(failed: Mapping[str, Exception], out: Path) -> None:
    """Raise InputError for files that the disk did not accept; any other error is a bug, and is raised unchanged."""
    for error in failed.values():
        if not isinstance(error, InputError | OSError):
            raise error
    if failed:
        # the text of the first error: one disk has one reason
        first = next(iter(failed.values()))
        cause = first.__cause__ if isinstance(first, InputError) else first
        reason = cause.strerror if isinstance(cause, OSError) else str(first)
        there = ", ".join(sorted(p.name for p in out.iterdir())) if RECORD_FILE not in failed else "nothing"
        raise InputError(
            f"{out}: not written: {', '.join(failed)} ({reason}); written: {there}; make room, or choose another "
            "place, and run again"
        )


def _write_tracks(result: RunResult, path: Path) -> None:
    with whole_file(path) as temporary:
        write_npz(result.tracks, temporary)


def _write_commands(commands: Any, path: Path) -> None:
    lines = [",".join(("time_ns", *commands.names))]
    lines += [
        ",".join((str(int(t)), *(repr(float(v)) for v in row)))
        for t, row in zip(commands.time_ns, commands.values, strict=True)
    ]
    write_text(path, "\n".join(lines) + "\n")
