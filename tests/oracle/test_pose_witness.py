"""Poses beside mink, inverse kinematics on MuJoCo by quadratic programmes: one least squares has one solution."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mosca.skeleton.model import Kinematics
from mosca.skeleton.start import starting_pose
from tests.benchmarks.bench_skeleton import compared, followed, ours
from tests.studies.skeleton_actor import actor_take


@pytest.mark.filterwarnings("ignore")  # mink's own
def test_mink_finds_the_same_poses_and_no_lower_cost() -> None:
    for name in ("mink", "daqp"):
        pytest.importorskip(name, reason=f"{name} is not installed: pip install -e '.[bench]'")
    model, frames, _ = actor_take("dance", 0.2, markers=60)
    # the template's own markers in the actor's poses, with 2 mm of noise: nobody needs to be fitted
    kinematics, rng = Kinematics(model), np.random.default_rng(1)
    solver = ours(kinematics, np.tile(0.02**-2 * np.eye(3), (len(model.labels), 1, 1)))
    markers = []
    for q in followed(solver, starting_pose(kinematics, frames.xyz[0]).q, frames)[0]:
        kinematics.pose(q)
        markers.append(kinematics.markers() + rng.normal(0, 0.002, (len(model.labels), 3)))
    subject = SimpleNamespace(model=model, parameters=model.parameters, skin_m=np.full(len(model.labels), 0.002))
    found, theirs = compared(subject, replace(frames, xyz=np.array(markers))).values()  # type: ignore[arg-type]
    assert (found[1] <= theirs[1] * (1 + 1e-6)).all()
    np.testing.assert_allclose(found[2], theirs[2], atol=2e-6)
