"""The fault clinic on takes that were not used to build it: the faults of ``clinic/*``, and healthy takes.

    python -m tests.studies.clinic_draw "clinic held out, fourth draw, 335fb089" faults
    python -m tests.studies.clinic_draw "clinic held out, fourth draw, 335fb089" healthy
    python -m tests.studies.clinic_draw FOLDER_OF_REAL_DATA real

A draw is a phrase; a take's seed are the first six digits of the SHA-256 of phrase, blank and name. Healthy takes are
``ALIKE`` seeds of ``clinic/healthy`` ("healthy 1" and so on) and the first ``OTHERS`` scenarios of other families in
the order of the same digest, ``SECONDS`` long, recorded as ``mosca run --record`` does and read as ``mosca clinic``
does, with the rig that the run believed in. Real takes are labelled ones in files, recorded traffic of Motive, and
videos of boards. Exit code 1 where a cause is missed in more than ``MISSED_AT_MOST`` takes, or named in one that is
healthy.
"""

import argparse
import hashlib
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from mosca.clinic.diagnose import ClinicReport, diagnose_tracks
from mosca.data.tracks import Tracks
from scenarios.commands.clinic import ClinicRequest, clinic_of
from scenarios.run.library import run_scenario
from scenarios.spec.catalog import LIBRARY, find
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions

FAMILIES = ("lenses", "light", "rigs", "sensors", "spaces", "subjects", "targets")
"""Of scenarios whose cameras stand still, expose at one instant and lose nothing."""
PLANTED = frozenset(
    {
        # lenses that their model misses
        "lenses/model_gap_stress", "lenses/rational_as_mosca", "lenses/tilted_sensor",
        # white markers, reflections, and spots that never move: lamps, shiny places, pixels
        "light/saturated", "light/mirror_outside", "light/polished_floor_left_out", "light/shiny_spots_outside",
        "light/glare", "light/ring_lights", "sensors/hot_and_dead_pixels",
    }
)  # fmt: skip
"""What has by intention what a cause of the clinic is named after."""
SLOW = frozenset({"subjects/boxing", "subjects/dance", "subjects/jump"})
"""Minutes of images each."""
TRAFFIC = "natnet/traffic.pcapng"
THERE = {"c3d_trc/kineticstoolkit/walkingOptiTrack.c3d": ("labels-swapped",)}
"""Causes that a real take has: two markers of a foot have each other's label from frame 1952 on."""
ALIKE, OTHERS, SECONDS, MISSED_AT_MOST = 8, 12, 1.5, 2


def digest(phrase: str, name: str) -> str:
    """Return the digest of a take, hexadecimal."""
    return hashlib.sha256(f"{phrase} {name}".encode()).hexdigest()


def seed(phrase: str, name: str) -> int:
    """Return the seed of a take."""
    return int(digest(phrase, name)[:6], 16)


def fault_names() -> list[str]:
    """Return the names of the clinic's scenarios that have a fault."""
    return sorted(path.stem for path in (LIBRARY / "clinic").glob("*.toml") if path.stem != "healthy")


def other_names(phrase: str) -> list[str]:
    """Return the healthy scenarios of other families, in the order in which a draw takes them."""
    names = [f"{family}/{path.stem}" for family in FAMILIES for path in (LIBRARY / family).glob("*.toml")]
    healthy = [name for name in names if name not in PLANTED | SLOW and load_scenario(find(name)).expect == "pass"]
    return sorted(healthy, key=lambda name: digest(phrase, name))


def faults(phrase: str, only: Sequence[str]) -> Iterator[tuple[str, bool, str]]:
    """Yield name, whether the right cause came first, and what was found."""
    for name in only or fault_names():
        record = run_scenario(f"clinic/{name}", {"seed": seed(phrase, name)}).record
        yield name, record.passed, record.verdict


def healthy(phrase: str, only: Sequence[str]) -> Iterator[tuple[str, bool, str]]:
    """Yield name, whether no cause was named, and what was found."""
    alike = [f"healthy {k}" for k in range(1, ALIKE + 1)]
    for name in only or [*alike, *other_names(phrase)[:OTHERS]]:
        if name in alike:
            record = run_scenario("clinic/healthy", {"seed": seed(phrase, name)}).record
            yield name, record.passed, record.verdict
            continue
        with tempfile.TemporaryDirectory() as folder:
            take = Path(folder) / "take"
            changes = {"seed": seed(phrase, name), "capture.duration_s": SECONDS}
            run_scenario(name, changes, options=RunOptions(record_to=take))
            report = clinic_of(ClinicRequest(take))
        yield name, not report.causes, in_words(report)


def in_words(report: ClinicReport) -> str:
    """Return what was found, as a line."""
    codes = ", ".join(one.code for one in report.causes) or "no cause"
    return codes + (f"; not judged: {'; '.join(report.not_judged)}" if report.not_judged else "")


def real(folder: str, only: Sequence[str]) -> Iterator[tuple[str, bool, str]]:
    """Yield name, whether no cause was named but one that is there, and what was found, of real takes."""
    data = Path(folder)
    requests = {str(path.relative_to(data)): ClinicRequest(path) for path in files_of(data, ".c3d", ".trc")}
    sleap, caliscope = data / "sleap_anipose", data / "caliscope_4cam/sessions/4_cam_recording"
    videos = caliscope / "calibration/extrinsic"
    requests["sleap_anipose"] = ClinicRequest(sleap, sleap / "calibration.toml", 30.0)
    requests["caliscope_4cam"] = ClinicRequest(videos, caliscope / "camera_array.toml", 6.0)
    for name in only or [*requests, TRAFFIC]:
        report = diagnose_tracks(traffic(data / name), None) if name == TRAFFIC else clinic_of(requests[name])
        yield name, [one.code for one in report.causes] == list(THERE.get(name, ())), in_words(report)


def files_of(folder: Path, *suffixes: str) -> list[Path]:
    """Return the files below a folder whose names end so."""
    return sorted(path for path in folder.rglob("*") if path.suffix in suffixes)


def traffic(path: Path) -> Tracks:
    """Return the labelled markers of recorded NatNet traffic of version 3.0, as the package natnet reads them."""
    from tests.hardware.natnet_witness import datagrams, parsed_frame

    rows = []
    for _, data in datagrams(path):
        if data[:2] == b"\x07\x00":
            frame, _ = parsed_frame(data, (3, 0))
            time_ns = round(frame.suffix.timestamp * 1e9)
            rows += [(frame.prefix.frame_number, time_ns, one.id_num, *one.pos) for one in frame.labeled_markers]
    table = np.array(rows)
    n, number = len(table), table[:, 2].astype(int)
    return Tracks(
        table[:, 0].astype(int), table[:, 1].astype(np.int64), number, number.astype(str), table[:, 3:],
        np.full((n, 3, 3), np.nan), np.full(n, -1), np.full(n, np.nan), np.full(n, "measured"),
    )  # fmt: skip


def main() -> None:
    """Print a line for each take, and how many went well."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("phrase", help="of the draw; of real takes: the folder that they are in")
    parser.add_argument("part", choices=["faults", "healthy", "real"])
    parser.add_argument("only", nargs="*", help="names of single takes; default: all")
    given = parser.parse_args()
    takes = {"faults": faults, "healthy": healthy, "real": real}[given.part](given.phrase, given.only)
    right, n, since = 0, 0, time.monotonic()
    for name, well, told in takes:
        n, right = n + 1, right + well
        drawn = "" if given.part == "real" else f"seed {seed(given.phrase, name)}, "
        taken = time.monotonic() - since
        print(f"{'right' if well else 'WRONG'}  {name}, {drawn}{taken:.0f} s: {told}", flush=True)
        since = time.monotonic()
    print(f"{right} of {n}")
    allowed = MISSED_AT_MOST if given.part == "faults" else 0
    sys.exit(int(n - right > allowed))


if __name__ == "__main__":
    main()
