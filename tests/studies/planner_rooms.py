"""Predicted beside simulated errors of planned rigs, in rooms that are drawn. Run: ``python planner_rooms.py``.

Each room has its own size, volume, markers, number of cameras, sensor and obstacles; every fourth a subject that
hides its own markers. The plan is simulated with a calibration estimated from rendered images, as by ``mosca plan
--verify``. The calibration's error is common to all points of a simulation, and the prediction is an rms over
calibrations: each room is simulated ``--draws`` times with other seeds. ``--rooms 3 5``: only these; seconds to a
minute a draw on two cores.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mosca.errors import CalibrationError
from scenarios.spec.plan import PlanFile
from scenarios.studies.plan.plan import PlanSettings, make_plan
from scenarios.studies.plan.scenario import write_scenario
from scenarios.studies.plan.verify import Verified, verify

EVALUATIONS = 600
WITHIN = 0.1
SENSORS = (
    ((1280, 1024), 0.0048, (4.0, 6.0, 8.0)),
    ((656, 491), 0.0099, (5.0, 7.5)),
    ((1936, 1216), 0.00586, (6.0, 8.0, 12.0)),
)


def drawn_room(number: int) -> PlanFile:
    """Return room ``number``."""
    draw = np.random.default_rng(1000 + number)
    half = draw.uniform([2.4, 2.2], [4.0, 3.5])
    size = draw.uniform([1.2, 1.2, 1.0], [2.4, 2.2, 1.8])
    center = [*draw.uniform(-0.3, 0.3, 2), size[2] / 2 + 0.2]
    size_px, pitch, lenses = SENSORS[int(draw.integers(len(SENSORS)))]
    x, y = half
    document: dict[str, Any] = {
        "title": f"room {number}",
        "seed": number,
        "volume": {
            "center_m": center, "size_m": size.tolist(),
            "marker_diameter_m": float(draw.choice([0.014, 0.018, 0.025])),
        },
        "room": {
            "corners_m": [[-x, -y], [x, -y], [x, y], [-x, y]], "height_m": 3.0,
            "mount_heights_m": [1.0, float(draw.uniform(2.2, 2.9))],
        },
        "camera": [
            {"model": "camera", "size_px": size_px, "pixel_pitch_mm": pitch, "focal_lengths_mm": lenses},
        ],
        "budget": {"cameras": int(draw.integers(4, 9))},
    }  # fmt: skip
    document["obstacle"] = [
        {
            "kind": kind, "center_m": [float(sign * (size[0] / 2 + 0.4)), float(draw.uniform(-1, 1)), 1.0],
            "size_m": [0.3, 0.3, 2.0], "yaw_deg": float(draw.uniform(0, 90)),
        }
        for kind, sign in (("box", 1), ("cylinder", -1))[: int(draw.integers(0, 3))]
    ]  # fmt: skip
    if number % 4 == 3:
        document["subject"] = {"directions": 8}
    return PlanFile.model_validate(document)


def verified_room(number: int, folder: Path, draws: int, workers: int = 2) -> list[Verified]:
    """Plan and simulate a room in ``folder``; return what was found in each draw that could be calibrated."""
    plan = make_plan(drawn_room(number), PlanSettings(EVALUATIONS, curve=False))
    folder.mkdir(parents=True, exist_ok=True)
    write_scenario(plan, folder)
    found = []
    for draw in range(draws):
        try:
            found.append(verify(plan, folder, workers, seed=number + 100 * draw)[0])
        except CalibrationError as error:
            print(f"{number:4d} draw {draw}: {error}", flush=True)
    return found


def ratio_of(found: Sequence[Verified]) -> float:
    """Return predicted over simulated rms error over all draws."""
    predicted, simulated = (
        np.mean([getattr(one, name) ** 2 for one in found]) for name in ("predicted_rms_m", "simulated_rms_m")
    )
    return float(np.sqrt(predicted / simulated))


def row(number: int, found: Sequence[Verified]) -> str:
    """Return a line of the table."""
    room = drawn_room(number)
    predicted, simulated = (
        1e3 * np.sqrt(np.mean([getattr(one, name) ** 2 for one in found]))
        for name in ("predicted_rms_m", "simulated_rms_m")
    )
    p95 = np.mean([one.predicted_p95_m for one in found]) / np.mean([one.simulated_p95_m for one in found])
    unseen = 100 * (1 - found[0].predicted_unseen), 100 * float(np.mean([one.completeness for one in found]))
    singles = " ".join(f"{one.ratio:.2f}" for one in found)
    return (
        f"{number:4d} {room.budget.cameras:8d} {'yes' if room.subject else 'no':>8s} {predicted:10.4f}"
        f" {simulated:10.4f} {ratio_of(found):6.3f} {p95:6.3f} {unseen[0]:9.1f} {unseen[1]:9.1f}   {singles}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, nargs="*", default=list(range(10, 20)))
    parser.add_argument("--draws", type=int, default=4)
    given = parser.parse_args()
    print(
        "room  cameras  subject  predicted  simulated rms [mm]; ratio, of p95; measured [%] predicted, simulated;"
        " ratio of each draw",
        flush=True,
    )
    close = 0
    for number in given.rooms:
        with tempfile.TemporaryDirectory() as folder:
            found = verified_room(number, Path(folder), given.draws)
        if found:
            close += abs(ratio_of(found) - 1) <= WITHIN
            print(row(number, found), flush=True)
    print(f"within {100 * WITHIN:.0f} %: {close} of {len(given.rooms)}")


if __name__ == "__main__":
    main()
