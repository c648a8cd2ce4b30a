"""The joint fit beside the spring model of the Guide to Optical Motion Capture, on the actor, whose joints are known.

Run: ``python -m tests.studies.skeleton_baseline [--actions ACTION ...] [--skins off moderate] [--seconds S]
[--seeds N] [--each] [--stiffness K ...]``. Rms over joints, frames and seeds of the centres' distances [mm] and of
the rotations' angles [deg]; "both": only joints whose rotation both state. 60 markers, 0.3 mm noise a coordinate, no
cameras. ``--scenarios people/walk_rigid ...``: through images, both of one run of a scenario, scored as its metrics
``joint_center_rms`` and ``joint_angle_rms`` are.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from mosca.data.joint_motion import JointMotion
from mosca.skeleton.fit import fit_subject
from mosca.skeleton.marker_frames import marker_frames
from mosca.skeleton.model import HUMAN, read_skeleton_model
from mosca.skeleton.spring_fit import JOINT_STIFFNESS, spring_fit
from mosca.skeleton.track import track_subject
from scenarios.run.scenario import run_scenario
from scenarios.score.people import centre_errors, joint_scores, rotation_errors
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions
from tests.studies.skeleton_actor import actor_take, joint_errors, rms

Errors = dict[str, tuple[float, float]]


def compared(
    action: str, skin: str, seed: int, seconds: float, stiffness: list[float]
) -> tuple[list[Errors], list[float]]:
    """Return errors by joint of ours and of the springs' (one for each stiffness), and ms a frame of each."""
    model, frames, truth = actor_take(action, seconds, seed=seed, skin=skin, markers=60)

    subject = fit_subject(model, frames)
    ways: list[Callable[[], JointMotion]] = [lambda: track_subject(subject, frames).joints]
    ways += [partial(spring_fit, model, frames, joint_stiffness=k) for k in stiffness]
    errors, spent_ms = [], []
    for way in ways:
        begun = time.process_time()
        joints = way()
        spent_ms.append(1e3 * (time.process_time() - begun) / len(frames))
        errors.append(joint_errors(joints, truth))
    return errors, spent_ms


def row(name: str, errors: list[list[Errors]], spent_ms: list[list[float]]) -> list[str]:
    """Return lines of the table: ours and the springs' over all seeds."""
    lines = []
    shared = {
        joint
        for joint in errors[0][0]
        if all(np.isfinite(one[joint][1]) for seed in errors for one in seed if joint in one)
    }
    for k in range(len(errors[0])):
        centre = 1e3 * rms(one[0] for seed in errors for one in seed[k].values())
        turn = np.rad2deg(rms(seed[k][joint][1] for seed in errors for joint in shared))
        ms = np.mean([seed[k] for seed in spent_ms])
        lines.append(f"{name:22} {'joint fit' if k == 0 else f'springs {k}':10} {centre:9.2f} {turn:9.2f} {ms:8.1f}")
    return lines


def in_scenario(name: str) -> str:
    """Return a line of the errors of a scenario's own skeleton and of springs in every second frame of its tracks."""
    path = find(name)
    done = run_scenario(load_scenario(path), name, path.parent, RunOptions(page=False))
    assert done.person is not None
    assert done.truth is not None
    model = done.person.subject.model
    frames = marker_frames(done.person.labelled, model.labels)
    springs = spring_fit(read_skeleton_model(HUMAN, model.labels), frames.select(np.arange(0, len(frames), 2)))
    scored = joint_scores(centre_errors(springs, done.truth), rotation_errors(springs, done.truth))
    own = {metric.name: metric.value for metric in done.record.metrics}
    cells = [
        f"{1e3 * value('joint_center_rms'):7.2f} mm {np.rad2deg(value('joint_angle_rms')):5.2f} deg"
        for value in (own.__getitem__, lambda metric: scored[metric].value)
    ]
    return f"{name:22} joint fit {cells[0]}   springs {cells[1]}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--actions", nargs="+", default=["dance", "boxing"])
    parser.add_argument("--skins", nargs="+", default=["off", "moderate"])
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--stiffness", nargs="+", type=float, default=[JOINT_STIFFNESS])
    parser.add_argument("--each", action="store_true", help="each joint too")
    parser.add_argument("--scenarios", nargs="+", default=[], help="through images, in place of the actions")
    given = parser.parse_args()
    if given.scenarios:
        for name in given.scenarios:
            print(in_scenario(name), flush=True)
        return
    print(f"springs: joint stiffness {given.stiffness} of a marker's")
    print(f"{'':33} {'centres':>9} {'rotations':>9} {'ms/frame':>8}\n{'':33} {'mm':>9} {'deg, both':>9}")
    for action in given.actions:
        for skin in given.skins:
            done = [compared(action, skin, s, given.seconds, given.stiffness) for s in range(1, 1 + given.seeds)]
            print("\n".join(row(f"{action}, {skin}", [one for one, _ in done], [ms for _, ms in done])), flush=True)
            if given.each:
                for joint in done[0][0][0]:
                    cells = [
                        f"{1e3 * rms(one[k][joint][0] for one, _ in done):7.2f} mm "
                        f"{np.rad2deg(rms(one[k][joint][1] for one, _ in done)):6.2f} deg"
                        for k in range(1 + len(given.stiffness))
                    ]
                    print(f"  {joint:12} {'   |   '.join(cells)}", flush=True)


if __name__ == "__main__":
    main()
