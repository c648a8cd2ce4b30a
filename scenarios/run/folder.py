"""The run folder: checked before a long run, written whole or not at all."""

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from mosca.data.files.rig_file import write_rig
from mosca.data.tracks import write_npz
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import write_bodies_csv
from mosca.formats.tracks.tracks_csv import write_tracks_csv
from reports.calibration_page import write_calibration_page
from reports.page import write_page
from reports.record import write_record
from scenarios.run.scenario import RunResult


def check_out(out: Path) -> None:
    """Raise InputError where ``out`` cannot become a run folder; ask before a long run, not after it."""
    if out.is_file():
        raise InputError(f"{out}: is a file; choose a folder with --out")
    if out.exists() and not (out / "record.json").exists() and any(out.iterdir()):
        raise InputError(f"{out}: holds other files and no record.json; choose a new folder with --out")


def write_run(result: RunResult, out: Path, rrd: Path | None = None) -> None:
    """Write the run folder; it appears whole or not at all. An earlier run folder there is replaced."""
    check_out(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}."))
    try:
        write_record(result.record, part / "record.json")
        write_npz(result.tracks, part / "tracks.npz")
        write_tracks_csv(result.tracks, part / "tracks.csv")
        write_page(part / "report.html", result.record, result.evidence)
        if result.poses is not None:
            write_bodies_csv(result.poses, part / "bodies.csv")
        if result.commands is not None:
            _write_commands(result.commands, part / "commands.csv")
        if result.calibration is not None:
            if not result.calibration.calibration.refused:  # its page says why; nobody can measure with it
                write_rig(result.calibration.calibration.rig, part / "rig.toml")
            write_calibration_page(
                part / "calibration.html", result.calibration.calibration, result.calibration.evidence
            )
        if rrd is not None:
            shutil.move(rrd, part / "run.rrd")
        part.chmod(0o755)
        if out.exists():
            shutil.rmtree(out)
        os.replace(part, out)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def _write_commands(commands: Any, path: Path) -> None:
    lines = [",".join(("time_ns", *commands.names))]
    lines += [
        ",".join((str(int(t)), *(repr(float(v)) for v in row)))
        for t, row in zip(commands.time_ns, commands.values, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
