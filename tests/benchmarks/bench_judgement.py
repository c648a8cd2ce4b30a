"""False alarms of the calibration's verdict: random good rigs through the production entry point.

    python tests/benchmarks/bench_judgement.py [RIGS]

Half of the rigs are calibrated from a field in five poses, a quarter from a field in one pose, a quarter from a
board that is carried about; 3 to 6 cameras, noise 0.02 px, bodies that shake by 0.03 px, 1 % of the image points 5 px
off. Every calibration is judged as by ``mosca calibrate``; 0 findings are expected.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "mosca"))

from rigid_scenes import board_marks, carried, seen, some_rig, still, stood

from mosca.calibration.quality.checks import check_calibration
from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.data.calibration import Finding
from mosca.errors import CalibrationError


def findings(seed: int) -> list[str]:
    """Return the findings beyond notes of the calibration of one random rig."""
    rng = np.random.default_rng(seed)
    model = ("mosca", "opencv")[seed % 2]
    rig = some_rig(rng, int(rng.integers(3, 7)), model)
    if seed % 4 == 3:
        target, poses = RigidTarget("board", board_marks()), carried(rng, 120)
    else:
        marks = rng.uniform(-1, 1, (160, 3)) * [1.6, 1.6, 1.1]
        target = RigidTarget("test field", marks)
        poses = still(20) if seed % 4 == 1 else stood(rng, 5, 6)
    sightings = seen(rig, target.marks_m, poses, rng, noise=0.02, shake=0.03)
    wrong = rng.random(len(sightings)) < 0.01
    xy = sightings.xy_px + wrong[:, None] * rng.normal(0, 5, (len(sightings), 2))
    object.__setattr__(sightings, "xy_px", xy)
    try:
        made = calibrate_rigid(sightings, target, RigidSettings(LensChoice(model, 0.0099)))
    except CalibrationError as error:
        return [str(error)]
    told: tuple[Finding, ...] = check_calibration(made, rigid_target=target.kind == "test field")
    return [f"{one.severity} {one.code}: {one.message}" for one in told if one.severity != "note"]


def main(rigs: int) -> None:
    """Print the findings of good rigs, and the number of rigs without any."""
    bad = 0
    for seed in range(rigs):
        told = findings(seed)
        bad += bool(told)
        for line in told:
            print(f"rig {seed}: {line}")
    print(f"{rigs - bad} of {rigs} good rigs are left in peace")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
