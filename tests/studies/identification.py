"""Intervals of a skid-steered robot's model in many drives, held against the best linear model of its true motion.

Run: ``python -m tests.studies.identification [--drives N] [--seconds S] [--orders N]``. The robot drives on contact
physics; poses have the noise that the 13 targets' stated covariance gives (``--sigma`` of a target [m]), drawn from
the least squares' own covariance. Nothing is rendered. Each drive's model is fitted as by ``mosca identify``: with
``--orders`` above 1 the order is chosen, as ``mosca identify`` does, else it is 1. The best linear model is that of
the true mean velocities of the next drives joined (``scenarios.score.identification``); the last is the unseen drive.
"""

import argparse

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.bodies import BodyPoses
from mosca.machines.identification.held_inputs import HeldInputs
from mosca.machines.identification.identify import IdentifySettings, fit_percent, identify
from mosca.machines.identification.output_error import OutputEstimate, OutputModel, OutputRecord, estimate, fit
from mosca.machines.identification.velocities import OUTPUTS, PlanarPath, mean_velocities, planar_path
from scenarios.score.identification import MOST_DELAY_S, TrueDrive, best_linear, driven_inputs, true_drive
from twin.scenes.robot import DECK_CENTRE_M, TARGET_XY_M, build_robot
from twin.scenes.scene import Scene

RATE_HZ = 100.0
NAMES = ("pole", "", "gain left", "gain right", "delay")
"""Quantities of a first-order model; the pole's imaginary part is 0."""


def robot(seed: int, seconds: float) -> Scene:
    """Return a drive on the paper's noise in 3 x 3 m."""
    return build_robot(
        duration_s=seconds, box_center_m=np.array([0.0, 0.0, 0.5]), box_size_m=np.array([3.0, 3.0, 1.0]),
        rng=np.random.default_rng([seed, 77]),
    )  # fmt: skip


def measured_path(scene: Scene, seed: int, sigma_m: float) -> PlanarPath:
    """Return the path of the deck's centre as 13 targets with ``sigma_m`` on each axis give it."""
    time_s = np.arange(int(scene.duration_s * RATE_HZ) + 1) / RATE_HZ
    qpos = np.array([scene.configuration_at(float(t))[:7] for t in time_s])
    world = Rotation.from_quat(qpos[:, 3:], scalar_first=True)
    normals = np.zeros((6, 6))
    for x, y in TARGET_XY_M:
        row = np.hstack([np.eye(3), np.cross(np.eye(3), [x, y, 0.0]).T])
        normals += row.T @ row
    own = sigma_m**2 * np.linalg.inv(normals)
    n, turn = len(time_s), np.zeros((len(time_s), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = world.as_matrix()
    noise = np.random.default_rng([seed, 5]).normal(size=(n, 6)) @ np.linalg.cholesky(own).T
    error = np.einsum("nij,nj->ni", turn, noise)
    quaternion = (Rotation.from_rotvec(error[:, 3:]) * world).as_quat(scalar_first=True)
    position = qpos[:, :3] + world.apply(DECK_CENTRE_M) + error[:, :3]
    covariance = turn @ own @ turn.transpose(0, 2, 1)
    time_ns, all13 = np.round(time_s * 1e9).astype(np.int64), np.full(n, 13)
    poses = BodyPoses(
        np.arange(n), time_ns, np.full(n, "robot"), quaternion, position, covariance, all13, np.full(n, np.nan),
        np.full(n, "measured"),
    )  # fmt: skip
    return planar_path(poses, "study")


def estimates(path: PlanarPath, inputs: HeldInputs, orders: int) -> list[OutputEstimate]:
    """Return the models of both outputs."""
    if orders > 1:
        return [one.estimate for one in identify(path, inputs, IdentifySettings(most_order=orders)).outputs]
    found = []
    for values in mean_velocities(path).T:
        record = OutputRecord(path.grid, values, inputs)
        found.append(estimate(record, fit(record, np.log([0.2 / path.period_s]), 0.0, MOST_DELAY_S)))
    return found


def fit_of(model: OutputModel, drive: TrueDrive, output: int) -> float:
    """Return the fit of a model on a true drive [%]."""
    answer = model.response(drive.inputs, drive.grid, means=True, from_rest=True)
    return float(fit_percent(drive.velocities[:, output : output + 1], answer[:, None])[0])


def main() -> None:
    """Print how often each quantity is within its interval, and the fits on the unseen drive."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--sigma", type=float, default=0.00012)
    parser.add_argument("--orders", type=int, default=1)
    parser.add_argument("--reference", type=int, default=20, help="drives that the best linear model is fitted to")
    given = parser.parse_args()
    first = given.drives
    drives = [true_drive(robot(first + k, given.seconds), RATE_HZ) for k in range(given.reference + 1)]
    start = OutputModel(np.log([0.2 * RATE_HZ]), 0.0, np.zeros(1))
    best = [best_linear(drives[:-1], k, start) for k in range(2)]
    wanted = [np.array([m.poles[0].real, 0.0, *m.gains(2), m.delay_s]) for m in best]
    inside, shares, orders = np.zeros((2, 5), int), np.zeros((given.drives, 2)), np.zeros(2, int)
    for seed in range(given.drives):
        scene = robot(seed, given.seconds)
        found = estimates(measured_path(scene, seed, given.sigma), driven_inputs(scene), given.orders)
        for k, one in enumerate(found):
            shares[seed, k] = fit_of(one.model, drives[-1], k) / fit_of(best[k], drives[-1], k)
            if len(one.model.logs) > 1:
                orders[k] += 1
                continue
            low, high = one.intervals.T
            inside[k] += (low <= wanted[k]) & (wanted[k] <= high)
    for k, name in enumerate(OUTPUTS):
        print(f"{name}: best linear model {np.round(wanted[k], 6)}, fit {fit_of(best[k], drives[-1], k):.2f} %")
        counts = ", ".join(f"{what} {inside[k, j]}" for j, what in enumerate(NAMES) if what)
        print(f"  within their intervals, of {given.drives - orders[k]}: {counts}; {orders[k]} of a higher order")
        print(f"  fit over the best linear model's: least {shares[:, k].min():.4f}, mean {shares[:, k].mean():.4f}")


if __name__ == "__main__":
    main()
