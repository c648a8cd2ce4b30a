"""Poses of a skeleton from its markers, ours beside mink (inverse kinematics on MuJoCo) with daqp: costs and times.

Run: ``pip install -e ".[bench]"``, ``python tests/benchmarks/bench_skeleton.py [--seconds S]``. Same model (a subject
fitted to the synthetic actor), same markers and weights, no robust weights; each starts from its own last pose and
stops at the same step. The cost is the sum of squares that both minimise, taken by our ``linearised`` for both. The
prior of the joints' rotations, about the rest pose, is WEAKER times weaker than ours, for mink's PostureTask takes
the identity for its derivative and does not quite minimise its own cost (at 1, mink's is 5 % higher). Processor time
of one thread.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from mosca.data.arrays import Array
from mosca.skeleton.fit import LEAST_SIGMA_M, FittedSubject, fit_subject
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.model import Kinematics
from mosca.skeleton.pose import SETTLED, linearised, solve_pose
from mosca.skeleton.start import starting_pose
from tests.studies.skeleton_actor import actor_take

NOT_ROBUST = 1e6
"""Standard deviations beyond which a marker weighs less: never."""
ITERATIONS = 30
WEAKER = 100.0
Solver = Callable[[Array, Array], Array]
"""Pose (nq,) and markers (m, 3) to a pose (nq,)."""


def ours(kinematics: Kinematics, information: Array) -> Solver:
    """Return our solver; ``information`` (m, 3, 3)."""
    return lambda q, xyz: solve_pose(kinematics, q, xyz, information, robust=NOT_ROBUST, iterations=ITERATIONS).q


def minks(kinematics: Kinematics, sigma_m: Array) -> Solver:
    """Return mink's solver of the same least squares; ``sigma_m`` (m,). ImportError where mink or daqp is missing."""
    import daqp  # noqa: F401
    import mink

    configuration = mink.Configuration(kinematics.mj)
    markers = [
        mink.FrameTask(label, "site", position_cost=1 / sigma, orientation_cost=0.0)
        for label, sigma in zip(kinematics.model.labels, sigma_m, strict=True)
    ]
    prior = mink.PostureTask(kinematics.mj, cost=1 / kinematics.model.rotation_sigma)
    prior.set_target(kinematics.mj.qpos0)

    def solve(q: Array, xyz: Array) -> Array:
        configuration.update(q)
        for _ in range(ITERATIONS):
            for task, place in zip(markers, xyz, strict=True):
                # its error is a logarithm of SE(3): a distance only where the target is turned as the frame is
                turned = configuration.get_transform_frame_to_world(task.frame_name, "site").rotation()
                task.set_target(mink.SE3.from_rotation_and_translation(turned, place))
            step = mink.solve_ik(configuration, [*markers, prior], 1.0, "daqp", damping=1e-9, limits=[])
            configuration.integrate_inplace(step, 1.0)
            if np.abs(step).max() < SETTLED:
                break
        return np.array(configuration.q)

    return solve


def followed(solver: Solver, start: Array, frames: MarkerFrames) -> tuple[Array, float]:
    """Return the poses (n, nq) of all frames and the processor time of one [ms], without the first."""
    poses = [solver(start, frames.xyz[0])]
    begun = time.process_time()
    for xyz in frames.xyz[1:]:
        poses.append(solver(poses[-1], xyz))
    return np.array(poses), 1e3 * (time.process_time() - begun) / max(len(frames) - 1, 1)


def compared(subject: FittedSubject, frames: MarkerFrames) -> dict[str, tuple[float, Array, Array]]:
    """Return name -> ms a frame, costs (n,), markers' distances (n, m) [m]: ours and, where it is there, mink's."""
    weaker = replace(subject.model, rotation_sigma=WEAKER * subject.model.rotation_sigma)
    kinematics = Kinematics(weaker, subject.parameters)
    sigma = np.hypot(np.maximum(subject.skin_m, LEAST_SIGMA_M), np.sqrt(frames.covariance[0, 0, 0, 0]))
    information = sigma[:, None, None] ** -2.0 * np.eye(3)
    start = starting_pose(kinematics, frames.xyz[0]).q
    solvers = {"ours": ours(kinematics, information)}
    try:
        solvers["mink with daqp"] = minks(kinematics, sigma)
    except ImportError as error:
        print(f"mink: skipped, {error}: pip install -e '.[bench]'")
    found = {}
    for name, solver in solvers.items():
        poses, ms = followed(solver, start, frames)
        at = [
            linearised(kinematics, q, xyz, information, NOT_ROBUST) for q, xyz in zip(poses, frames.xyz, strict=True)
        ]
        away = np.array([np.linalg.norm(one.residual, axis=1) for one in at])
        found[name] = ms, np.array([one.cost for one in at]), away
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--actions", nargs="+", default=["dance", "boxing"])
    given = parser.parse_args()
    print(f"{'':8} {'':15} {'ms/frame':>9} {'mean cost':>10} {'markers rms mm':>15}")
    for action in given.actions:
        model, frames, _ = actor_take(action, given.seconds, skin="moderate", markers=60)
        subject = fit_subject(model, frames.select(np.arange(0, len(frames), 10)))
        found = compared(subject, frames)
        for name, (ms, cost, away) in found.items():
            print(f"{action:8} {name:15} {ms:9.2f} {cost.mean():10.3f} {1e3 * np.sqrt(np.mean(away**2)):15.4f}")
        if len(found) == 2:
            (our_ms, our_cost, our_away), (their_ms, their_cost, their_away) = found.values()
            print(
                f"{action:8} mink's time / ours {their_ms / our_ms:.1f}; our cost / mink's at most "
                f"{(our_cost / their_cost).max():.9f}, at least {(our_cost / their_cost).min():.9f}; distances "
                f"of the markers differ by at most {1e6 * np.abs(our_away - their_away).max():.2f} um"
            )


if __name__ == "__main__":
    main()
