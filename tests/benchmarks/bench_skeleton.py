"""A person's pose frame by frame, ours beside mink (on MuJoCo, with daqp) and OpenSim: times and costs in one run.

Run: ``pip install -e ".[bench]"``, ``python tests/benchmarks/bench_skeleton.py [--seconds S] [--markers M]``. Same
bodies (a subject fitted to the synthetic actor) and markers; each starts from its own last pose. ``live`` is all that
a frame takes of us: weights, the robust pose and the joints with their covariance. The others have no covariance, no
robust weights and beside them stands our pose without either. mink minimises the same sum of squares, taken by our
``linearised`` for both, and stops at the same step. The prior of the joints' rotations, about the rest pose, is
WEAKER times weaker than ours, for mink's PostureTask takes the identity for its derivative and does not quite
minimise its own cost (at 1, mink's is 5 % higher). OpenSim has no such prior, and its ball joints are three angles
each; its accuracy is the default of its inverse kinematics tool. Times are of the processor, of one thread, frame by
frame in turn, without the first frame; on a shared machine they vary, their ratios less.
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
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[2]))

from mosca.data.arrays import Array
from mosca.skeleton.fit import LEAST_SIGMA_M, FittedSubject, fit_subject
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.model import HUMAN, Kinematics, read_skeleton_model
from mosca.skeleton.pose import SETTLED, linearised, solve_pose
from mosca.skeleton.start import starting_pose
from mosca.skeleton.track import SkeletonTracker
from tests.studies.skeleton_actor import actor_take

NOT_ROBUST = 1e6
"""Standard deviations beyond which a marker weighs less: never."""
ITERATIONS = 30
WEAKER = 100.0
OPENSIM_ACCURACY = 1e-5
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
            try:
                step = mink.solve_ik(configuration, [*markers, prior], 1.0, "daqp", damping=1e-9, limits=[])
            except mink.NoSolutionFound as error:
                raise RuntimeError(str(error)) from None
            configuration.integrate_inplace(step, 1.0)
            if np.abs(step).max() < SETTLED:
                break
        return np.array(configuration.q)

    return solve


def opensims(
    kinematics: Kinematics, start: Array, frames: MarkerFrames, sigma_m: Array
) -> tuple[Callable[[int], None], Callable[[], Array]]:
    """Return OpenSim's tracking of a frame and its markers' present distances [m]. ImportError without OpenSim."""
    import opensim

    opensim.Logger.removeFileSink()  # else it leaves opensim.log in the working folder
    opensim.Logger.setLevelString("Off")
    model, zero, mj = opensim.Model(), opensim.Vec3(0), kinematics.mj
    bodies = [model.getGround()]
    for k in range(1, mj.nbody):
        bodies.append(opensim.Body(mj.body(k).name, 1.0, zero, opensim.Inertia(1, 1, 1, 0, 0, 0)))
        model.addBody(bodies[-1])
        name, parent = f"to_{mj.body(k).name}", bodies[mj.body_parentid[k]]
        place = opensim.Vec3(*mj.body_pos[k].tolist())
        joint = (
            opensim.FreeJoint(name, parent, bodies[-1])
            if k == 1
            else opensim.BallJoint(name, parent, place, zero, bodies[-1], zero, zero)
        )
        model.addJoint(joint)
    weights, labels = opensim.SetMarkerWeights(), kinematics.model.labels
    for label, body, place, sigma in zip(labels, kinematics.body_of_marker, kinematics.local, sigma_m, strict=True):
        model.addMarker(opensim.Marker(label, bodies[body], opensim.Vec3(*place.tolist())))
        weights.cloneAndAppend(opensim.MarkerWeight(label, float(sigma**-2)))
    model.finalizeConnections()
    table = opensim.TimeSeriesTableVec3()
    table.setColumnLabels(list(labels))
    table.addTableMetaDataString("Units", "m")
    for k, xyz in enumerate(frames.xyz):
        row = opensim.RowVectorVec3(len(xyz))
        for column, place in enumerate(xyz):
            row[column] = opensim.Vec3(*place.tolist())
        table.appendRow(float(k), row)
    markers, state = opensim.MarkersReference(table, weights), model.initSystem()
    solver = opensim.InverseKinematicsSolver(model, markers, opensim.SimTKArrayCoordinateReference())
    solver.setAccuracy(OPENSIM_ACCURACY)
    names = [model.getJointSet().get(k).getName() for k in range(mj.njnt)]
    for name, quaternion in zip(names, start[3:].reshape(-1, 4), strict=True):
        turned = Rotation.from_quat(quaternion, scalar_first=True).as_euler("XYZ")
        values = [*turned, *start[:3]] if name == names[0] else turned
        joint = model.getJointSet().get(name)
        for k, value in enumerate(values):
            joint.get_coordinates(k).setValue(state, float(value), False)
    state.setTime(0.0)
    solver.assemble(state)

    def track(frame: int, _kept: object = (model, markers)) -> None:
        state.setTime(float(frame))
        solver.track(state)

    def distances() -> Array:
        return np.array([solver.computeCurrentMarkerError(label) for label in labels])

    return track, distances


def followed(solver: Solver, start: Array, frames: MarkerFrames) -> tuple[Array, Array]:
    """Return the poses (n, nq) of all frames and the processor time (n - 1,) of each but the first [ms]."""
    poses, ms = [solver(start, frames.xyz[0])], []
    for xyz in frames.xyz[1:]:
        begun = time.process_time()
        poses.append(solver(poses[-1], xyz))
        ms.append(1e3 * (time.process_time() - begun))
    return np.array(poses), np.array(ms)


def opensim_followed(
    kinematics: Kinematics, start: Array, frames: MarkerFrames, sigma_m: Array
) -> tuple[Array, Array]:
    """Return times (n - 1,) as ``followed``, and markers' distances (n, m) [m], by OpenSim."""
    track, distances = opensims(kinematics, start, frames, sigma_m)
    ms, away = [], [distances()]
    for k in range(1, len(frames)):
        begun = time.process_time()
        track(k)
        ms.append(1e3 * (time.process_time() - begun))
        away.append(distances())
    return np.array(ms), np.array(away)


def live(subject: FittedSubject, frames: MarkerFrames) -> tuple[Array, Array]:
    """Return the processor times (n - 1,) of each frame but the first [ms]: of the pose, of joints and covariance."""
    tracker, ms = SkeletonTracker(subject), []
    for xyz, covariance in zip(frames.xyz, frames.covariance, strict=True):
        begun = time.process_time()
        solution = tracker.step(xyz, covariance)
        between = time.process_time()
        assert solution is not None
        tracker.joints(solution)
        ms.append((between - begun, time.process_time() - between))
    return 1e3 * np.array(ms[1:])[:, 0], 1e3 * np.array(ms[1:])[:, 1]


def sigma_of(subject: FittedSubject, frames: MarkerFrames) -> Array:
    """Return the standard deviation (m,) of each marker against the model [m]."""
    return np.hypot(np.maximum(subject.skin_m, LEAST_SIGMA_M), np.sqrt(frames.covariance[0, 0, 0, 0]))


def compared(subject: FittedSubject, frames: MarkerFrames) -> dict[str, tuple[Array, Array, Array]]:
    """Return name -> times (n - 1,) [ms], costs (n,), markers' distances (n, m) [m]: ours, mink's if there."""
    weaker = replace(subject.model, rotation_sigma=WEAKER * subject.model.rotation_sigma)
    kinematics = Kinematics(weaker, subject.parameters)
    sigma = sigma_of(subject, frames)
    information = sigma[:, None, None] ** -2.0 * np.eye(3)
    start = starting_pose(kinematics, frames.xyz[0]).q
    solvers = {"ours": ours(kinematics, information)}
    try:
        solvers["mink with daqp"] = minks(kinematics, sigma)
    except ImportError as error:
        print(f"mink: skipped, {error}: pip install -e '.[bench]'")
    found = {}
    for name, solver in solvers.items():
        try:
            poses, ms = followed(solver, start, frames)
        except RuntimeError as error:
            print(f"{name}: skipped, {error}")
            continue
        at = [
            linearised(kinematics, q, xyz, information, NOT_ROBUST) for q, xyz in zip(poses, frames.xyz, strict=True)
        ]
        away = np.array([np.linalg.norm(one.residual, axis=1) for one in at])
        found[name] = ms, np.array([one.cost for one in at]), away
    return found


def line(action: str, name: str, ms: Array, rest: str = "") -> str:
    """Return a row of the table: mean, median and 99th percentile of ``ms`` (n,)."""
    return f"{action:8} {name:26} {ms.mean():8.2f} {np.median(ms):8.2f} {np.percentile(ms, 99):8.2f} {rest}"


def measured(action: str, subject: FittedSubject, frames: MarkerFrames) -> None:
    """Print the times of all on one take."""
    pose, joints = live(subject, frames)
    print(line(action, "ours, live", pose + joints))
    print(line(action, "  of which joints, covariance", joints))
    found = compared(subject, frames)
    for name, (ms, cost, away) in found.items():
        print(line(action, f"{name}, pose", ms, f"{cost.mean():10.3f} {1e3 * np.sqrt(np.mean(away**2)):8.4f}"))
    ours_ms, our_cost, our_away = found["ours"]
    ratios = []
    for name, (ms, cost, away) in list(found.items())[1:]:
        ratios.append((name, ms))
        print(
            f"{action:8} our cost / {name}'s at most {(our_cost / cost).max():.9f}, at least "
            f"{(our_cost / cost).min():.9f}; distances of the markers differ by at most "
            f"{1e6 * np.abs(our_away - away).max():.2f} um"
        )
    sigma = sigma_of(subject, frames)
    try:
        kinematics = Kinematics(subject.model, subject.parameters)
        start = starting_pose(kinematics, frames.xyz[0]).q
        ms, away = opensim_followed(kinematics, start, frames, sigma)
    except ImportError as error:
        print(f"OpenSim: skipped, {error}: pip install -e '.[bench]'")
    else:
        print(line(action, "OpenSim, pose", ms, f"{'':10} {1e3 * np.sqrt(np.mean(away**2)):8.4f}"))
        ratios.append(("OpenSim", ms))
    for name, ms in ratios:
        print(
            f"{action:8} {name}'s mean time / ours: {ms.mean() / ours_ms.mean():.1f}, pose; "
            f"{ms.mean() / (pose + joints).mean():.1f}, to ours with covariance"
        )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--markers", type=int, default=53, help="of the actor's 60, evenly left out")
    parser.add_argument("--actions", nargs="+", default=["dance", "boxing"])
    given = parser.parse_args()
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {given.markers} markers")
    print(f"{'':8} {'ms of the processor':26} {'mean':>8} {'p50':>8} {'p99':>8} {'mean cost':>10} {'rms mm':>8}")
    for action in given.actions:
        model, frames, _ = actor_take(action, given.seconds, skin="moderate", markers=60)
        kept = np.unique(np.linspace(0, len(model.labels) - 1, given.markers).round().astype(int))
        model = read_skeleton_model(HUMAN, [model.labels[k] for k in kept])
        frames = MarkerFrames(
            model.labels, frames.frame, frames.time_ns, frames.xyz[:, kept], frames.covariance[:, kept]
        )
        subject = fit_subject(model, frames.select(np.arange(0, len(frames), 10)))
        live(subject, frames.select(np.arange(2)))  # compiles
        measured(action, subject, frames)


if __name__ == "__main__":
    main()
