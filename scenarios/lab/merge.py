"""The reconstructing station: merged detections of all stations become tracks, by the stages of a local run."""

import tempfile
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from hardware.transport.merger import MergedSet
from hardware.transport.station_state import ReceiverStatistics
from mosca.data.detections import Detections
from mosca.data.files.rig_file import CameraTable, RigFile, camera_of, read_rig, read_rig_file, rig_toml
from mosca.data.files.toml import check, parse_toml
from mosca.data.frames import FrameSet
from mosca.data.rig import Rig
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings, Step, run_seen

KEPT_DELAYS = 500_000


def run_merged(sets: Iterable[MergedSet], rig: Rig, settings: PipelineSettings) -> Iterator[Step]:
    """Reconstruct tracks from merged detections, as ``mosca.pipeline.run_sets`` does from frame sets."""
    seen = ((FrameSet(s.pulse, s.time_ns), in_order(s.detections, rig), 0.0) for s in sets)
    return run_seen(seen, rig, replace(settings, lookahead=0))


def in_order(detections: Mapping[str, Detections], rig: Rig) -> dict[str, Detections]:
    """Return the detections of the rig's cameras, in its order."""
    return {name: detections[name] for name in rig.names if name in detections}


class Delays:
    """Latencies from the arrival of frames at the station to their merged set [s]."""

    def __init__(self) -> None:
        self._since_arrival: list[float] = []
        self._since_sent: list[float] = []

    def passed(self, sets: Iterable[MergedSet]) -> Iterator[MergedSet]:
        """Pass sets on and note their delays."""
        for merged in sets:
            if len(self._since_arrival) < KEPT_DELAYS:
                self._since_arrival += [(merged.merged_ns - at) * 1e-9 for at in merged.arrived_ns.values()]
                self._since_sent += [(merged.merged_ns - at) * 1e-9 for at in merged.sent_ns.values()]
            yield merged

    def percentiles(self, share: float) -> tuple[float, float]:
        """Return the ``share`` quantiles of the delays since a frame's arrival and since its message was sent."""
        if not self._since_arrival:
            return float("nan"), float("nan")
        return float(np.quantile(self._since_arrival, share)), float(np.quantile(self._since_sent, share))


def calibrated_rig(path: Path, from_stations: Callable[[], Mapping[str, str]]) -> tuple[Rig, list[str]]:
    """Return the rig of the file at ``path``, and notes.

    A camera that the file does not calibrate is taken from the rig file of its station. ``from_stations`` fetches
    these (station -> text) and is called only then. InputError where no file has the camera.
    """
    file = read_rig_file(path)
    if all(table.lens is not None and table.pose is not None for table in file.camera):
        return read_rig(path), []
    theirs: dict[str, tuple[str, CameraTable]] = {}
    for station, text in from_stations().items():
        for table in _parsed(station, text).camera:
            if table.lens is not None and table.pose is not None:
                theirs.setdefault(table.name, (station, table))
    cameras, notes = [], []
    for table in file.camera:
        if table.lens is None or table.pose is None:
            if table.name not in theirs:
                raise InputError(
                    f"{path}: camera '{table.name}' is not calibrated, and no station has its calibration; "
                    "calibrate it first (mosca calibrate)"
                )
            station, table = theirs[table.name]
            notes.append(f"camera '{table.name}': calibration of station {station}")
        cameras.append(camera_of(table, path))
    with tempfile.TemporaryDirectory() as folder:  # read again, so that it is checked like any other rig file
        whole = Path(folder) / path.name
        whole.write_text(rig_toml(Rig(tuple(cameras))), encoding="utf-8")
        return read_rig(whole), notes


def _parsed(station: str, text: str) -> RigFile:
    try:
        return check(RigFile, parse_toml(text), f"rig file of station {station}")
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"rig file of station {station}: not valid TOML: {error}") from None


def summary_lines(statistics: ReceiverStatistics) -> list[str]:
    """Return the summary of pulses, cameras and stations in words, with every loss."""
    merge = statistics.merge
    lines = [
        f"{merge.sets} sets merged, {merge.complete} of them complete; {merge.unseen} pulses between them that "
        "nobody saw"
    ]
    for name, c in merge.cameras.items():
        missing = {"without a frame": c.no_frame, "while its station was away": c.away, "not in time": c.lost}
        if counts := _counts(missing):
            lines.append(f"camera '{name}' is missing in {merge.sets - c.merged} sets: {counts}")
        if counts := _counts({"late": c.late, "too old": c.aged, "doubled": c.doubled}):
            lines.append(f"camera '{name}': messages thrown away: {counts}")
    for name, s in statistics.stations.items():
        counts = _counts(
            {
                "lost on the way": s.lost,
                "frames skipped by the station": s.skipped,
                "refused by its engine": s.refused,
                "before its pulses were known": s.unplaced,
                "of an earlier start": s.stale,
                "of a start that it does not confirm": s.unconfirmed,
                "not signed or sent again": s.forged,
                "unreadable": s.spoilt,
                "times silent": s.silent,
                "times started again": max(s.starts - 1, 0),
            }
        )
        clock = f"clock to {s.clock_error_ns * 1e-6:.2f} ms, skew {s.clock_skew * 1e6:+.1f} ppm"
        lines.append(f"station {name}: {s.received} messages ({clock})" + (f"; {counts}" if counts else ""))
    if statistics.left_out:
        lines.append(f"{statistics.left_out} merged sets left out: the reconstruction was behind")
    if statistics.strangers:
        lines.append(f"{statistics.strangers} messages under other names were not signed, and refused")
    if statistics.overrun:
        lines.append(f"{statistics.overrun} messages found no room: this PC was behind")
    return lines


def _counts(counts: Mapping[str, int]) -> str:
    """Return the counts that are not 0, each with its name."""
    return ", ".join(f"{number} {what}" for what, number in counts.items() if number)


def all_whole(statistics: ReceiverStatistics) -> bool:
    """Return whether there is a frame of every camera for every pulse."""
    return (
        statistics.merge.sets > 0
        and statistics.merge.sets == statistics.merge.complete
        and not statistics.merge.unseen
        and not statistics.left_out
    )
