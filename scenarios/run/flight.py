"""The flight of a scenario in closed loop: its data for the page and the run folder."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mosca.data.files.whole_file import write_text
from reports.flight_evidence import FlightEvidence
from scenarios.flight.loop import live_flight
from scenarios.flight.pilot import Pilot
from scenarios.flight.predicted import Flown, flown
from scenarios.run.pose_noise import shared_error_m2
from scenarios.session.estimated import SessionCalibration
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected
from twin.scenes.scene import Scene

_HEADER = "time_s,x,y,z,wanted_x,wanted_y,wanted_z,predicted_x,predicted_y,predicted_z,pose_age_s"


def flight_of(
    spec: Scenario, pilot: Pilot | None, scene: Scene | None, collected: Collected, own: SessionCalibration | None
) -> Flown | None:
    """Return the flight of a finished run, None where there was none; remarks are added to the notes.

    ``own``: the calibration of the scenario's session.
    """
    if pilot is None or scene is None:
        return None
    flight = live_flight(scene)
    flight.advance(spec.capture.duration_s)
    found = flown(spec, pilot, flight, shared_error_m2(spec, own))
    if found.path.crash:
        collected.assembly.notes["flight"] = f"the drone {found.path.crash} at {found.path.crashed_s:.2f} s"
    if found.delay_note:
        collected.assembly.notes["flight delay"] = found.delay_note
    if found.delay is not None:
        low, high = found.delay.ci95
        off = found.path.believed_delay_s
        if not low <= off <= high and abs(found.delay.delay_s - off) > found.delay.allowed_s:
            collected.assembly.notes["flight delay"] = (
                f"the poses' delay is {1e3 * found.delay.delay_s:.1f} ms by the flight's log, the predictor believes "
                f"in {1e3 * off:.1f} ms: set it right"
            )
    return found


def flight_evidence(found: Flown) -> FlightEvidence:
    """Return the data of the picture."""
    path, delay = found.path, found.delay
    words = found.delay_note or "not asked for"
    if delay is not None:
        words = f"{1e3 * delay.delay_s:.1f} ms, 95 % {1e3 * delay.ci95[0]:.1f} to {1e3 * delay.ci95[1]:.1f} ms"
    return FlightEvidence(
        path.time_s,
        path.wanted,
        path.position,
        path.estimated,
        path.pose_age_s,
        path.scored_from_s,
        path.crash,
        path.crashed_s,
        path.believed_delay_s,
        words,
    )


def flight_files(found: Flown) -> dict[str, Callable[[Path], object]]:
    """Return name of each file of a run folder -> function that writes it there."""
    return {"flight.csv": lambda path: _write_path(found, path)}


def _write_path(found: Flown, path: Path) -> None:
    one = found.path
    rows = np.column_stack([one.time_s, one.position, one.wanted, one.estimated, one.pose_age_s])
    lines = [",".join("" if not np.isfinite(v) else f"{v:.7g}" for v in row) for row in rows]
    write_text(path, "\n".join([_HEADER, *lines]) + "\n")
