"""Recorded people drive the actor (CMU motion capture database)."""

from pathlib import Path

import pytest

from scenarios.run.scenario import run_scenario
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario

CMU = Path("cmu_mocap")


@pytest.mark.data
@pytest.mark.parametrize(
    ("motion", "skeleton", "more"),
    [
        ("asfamc/02/02_05.amc", "asfamc/02/02.asf", ()),
        ("asfamc/usc520/131_04-dance.amc", "asfamc/usc520/131-dance.asf", ()),
        ("bvh/13/13_11.bvh", None, ("scene.metres_per_unit=0.0104",)),
    ],
    ids=["punch", "dance", "jump"],
)
def test_a_recorded_person_is_measured(data_dir, motion, skeleton, more):
    path = find("actor")
    chosen = (f"scene.motion='{data_dir / CMU / motion}'", "capture.duration_s=0.6", *more)
    if skeleton:
        chosen = (*chosen, f"scene.skeleton='{data_dir / CMU / skeleton}'")
    record = run_scenario(load_scenario(path, chosen), "actor", path.parent).record
    # 0.05 % of 2.5 m: recorded people bend and crouch, so that more markers are half hidden than in the gait
    # (measured 0.5-0.9 mm); completeness is low in these few frames, in which tracks only begin
    assert record.metric("position_rms").value <= 0.00125
    assert record.metric("completeness").value > 0.85
    assert record.metric("ghosts_per_frame").value <= 0.05
