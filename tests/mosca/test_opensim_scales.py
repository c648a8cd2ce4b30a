"""Scale factors for OpenSim's gait2354: by hand, and by OpenSim, whose scaled model has the subject's lengths."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mosca.formats.joints.opensim import write_scale_set
from mosca.skeleton.opensim_scales import GENERIC_M, gait2354_scales
from tests.skeleton_takes import made_subject

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "people" / "gait2354"
MODEL = DATA / "subject01_simbody.osim"
# scale_factors of the meshes in that file: what OpenSim's scale tool multiplied the generic model's bodies by
APPLIED = {"pelvis": 1.02458} | {
    f"{body}_{side}": factor
    for side in "rl"
    for body, factor in (
        ("femur", 1.14724), ("tibia", 0.988523), ("talus", 1.11398), ("calcn", 1.02708), ("toes", 1.02708))
}  # fmt: skip


def subject_of(lengths_m):
    """Return a subject whose distances between joints are given."""
    subject = made_subject()
    parameters = np.array(subject.parameters)
    half = lengths_m["hips"] / 2
    parameters[subject.model.joint_rows("l_hip")] = [0.0, 0.0, -half]
    parameters[subject.model.joint_rows("r_hip")] = [0.0, 0.0, half]
    for joint in ("l_knee", "r_knee", "l_ankle", "r_ankle"):
        parameters[subject.model.joint_rows(joint)] = [0.0, -lengths_m[joint], 0.0]
    return replace(subject, parameters=parameters)


LENGTHS_M = {"hips": 0.18, "l_knee": 0.45, "r_knee": 0.44, "l_ankle": 0.40, "r_ankle": 0.41}


def test_factors_are_lengths_in_those_of_the_generic_model():
    scales = gait2354_scales(subject_of(LENGTHS_M))
    assert scales["pelvis"] == pytest.approx((0.18 / 0.167,) * 3)
    assert scales["tibia_r"] == pytest.approx((0.41 / 0.43,) * 3)
    assert scales["femur_l"][1] / scales["femur_r"][1] == pytest.approx(0.45 / 0.44)
    # made_subject is 1.1 of a person of 1.75 m; the generic model's is 1.8 m
    assert scales["calcn_l"] == pytest.approx((1.1 * 1.75 / 1.8,) * 3)
    assert "torso" not in scales


def scaled(opensim, model, path):
    """Return the model scaled by a file, in its default pose with straight knees, and its state."""
    state = model.initSystem()
    assert model.scale(state, opensim.ScaleSet(str(path)), False)
    state = model.initSystem()
    for k in range(model.getCoordinateSet().getSize()):
        model.getCoordinateSet().get(k).setValue(state, 0.0, False)
    model.realizePosition(state)
    return model, state


@pytest.mark.data
def test_opensim_makes_the_generic_model_as_large_as_the_subject(tmp_path):
    opensim = pytest.importorskip("opensim", reason="opensim is not installed: pip install -e '.[bench]'")
    if not MODEL.is_file():
        pytest.skip(f"needs {MODEL} of MOSCA_DATA")
    opensim.Logger.setLevelString("Off")

    def lengths(model, state):
        place = {body: model.getBodySet().get(body).getPositionInGround(state).to_numpy() for body in APPLIED}
        away = {"hips": place["femur_r"] - place["femur_l"]}
        for s in "rl":
            away |= {f"{s}_knee": place[f"tibia_{s}"] - place[f"femur_{s}"]}
            away |= {f"{s}_ankle": place[f"talus_{s}"] - place[f"tibia_{s}"]}
        return {name: float(np.linalg.norm(off)) for name, off in away.items()}

    # back to the generic model, of which the constants are
    write_scale_set({body: (1 / one,) * 3 for body, one in APPLIED.items()}, tmp_path / "back.xml")
    generic = scaled(opensim, opensim.Model(str(MODEL)), tmp_path / "back.xml")
    before = lengths(*generic)
    assert before["hips"] == pytest.approx(GENERIC_M["pelvis"], abs=2e-5)
    assert before["r_knee"] == pytest.approx(GENERIC_M["femur"], abs=2e-5)
    assert before["l_ankle"] == pytest.approx(GENERIC_M["tibia"], abs=2e-5)
    write_scale_set(gait2354_scales(subject_of(LENGTHS_M)), tmp_path / "scale.xml")
    after = lengths(*scaled(opensim, generic[0], tmp_path / "scale.xml"))
    for name, wanted in LENGTHS_M.items():
        assert after[name] == pytest.approx(wanted, abs=1e-4), name
        assert abs(before[name] - wanted) > 5e-3  # the generic model has other lengths
