"""An identified model of a robot compared with the robot's true motion, and with the best linear model of that.

The best linear model has the orders of the identified model. It is fitted by the same least squares to the true mean
velocities of long drives with noise of the same kind (Pintelon and Schoukens 2012, chapter 3: the best linear
approximation, which depends on the kind of input). Both models are compared on a drive to which neither was fitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.machines.identification.held_inputs import HeldInputs, IntervalGrid
from mosca.machines.identification.identify import IdentifiedModel, fit_percent
from mosca.machines.identification.output_error import OutputModel, OutputRecord, fit
from mosca.machines.identification.velocities import OUTPUTS, BodyVelocities
from scenarios.score.tracks import BLOCKS, ratio_of_sums
from scenarios.types import Score
from twin.scenes.driving import true_velocities
from twin.scenes.robot import DECK_CENTRE_M
from twin.scenes.scene import Scene

SETTLED_S = 0.5
"""Part of each joined drive that is left out: the motion continues from the drive before, the robot's from rest."""
MOST_DELAY_S = 0.2


@dataclass(frozen=True, eq=False)
class TrueDrive:
    """A drive from rest: the held inputs, and the true mean v_x and yaw rate (n, 2) over ``grid``."""

    grid: IntervalGrid
    inputs: HeldInputs
    velocities: Array

    def __post_init__(self) -> None:
        set_read_only(self, velocities=(self.grid.n, 2))


def driven_inputs(scene: Scene, delay_s: float = 0.0) -> HeldInputs:
    """Return the PWM of the left and the right side, with times that are ``delay_s`` too early."""
    assert scene.commands is not None
    sides = [scene.commands.names.index(name) for name in ("pwm_left", "pwm_right")]
    return HeldInputs(("left", "right"), scene.commands.time_ns * 1e-9 - delay_s, scene.commands.values[:, sides])


def true_drive(scene: Scene, frame_rate_hz: float) -> TrueDrive:
    """Return a robot's true drive at a frame rate."""
    grid = IntervalGrid(0.0, 1.0 / frame_rate_hz, int(scene.duration_s * frame_rate_hz))
    at = grid.instants()
    means = true_velocities(scene.configuration_at, at[:-1], at[1:], np.array(DECK_CENTRE_M))
    return TrueDrive(grid, driven_inputs(scene), means)


def best_linear(drives: Sequence[TrueDrive], output: int, start: OutputModel) -> OutputModel:
    """Return the model of one output, with as many poles as ``start``, that fits the true ``drives`` best."""
    period = drives[0].grid.period_s
    ends = np.cumsum([drive.grid.n for drive in drives])
    values, times, commands = [], [], []
    for drive, end in zip(drives, ends, strict=True):
        begin = (end - drive.grid.n) * period
        inside = drive.inputs.time_s < drive.grid.n * period - 1e-9
        times.append(begin + drive.inputs.time_s[inside])
        commands.append(drive.inputs.values[inside])
        settled = np.arange(drive.grid.n) * period >= SETTLED_S
        values.append(np.where(settled, drive.velocities[:, output], np.nan))
    inputs = HeldInputs(drives[0].inputs.names, np.concatenate(times), np.concatenate(commands))
    record = OutputRecord(IntervalGrid(0.0, period, int(ends[-1])), np.concatenate(values), inputs)
    return fit(record, start.logs, start.delay_s, MOST_DELAY_S)


def velocity_scores(velocities: BodyVelocities, scene: Scene, period_s: float) -> dict[str, Score]:
    """Return rms errors and NEES of smoothed velocities against the true means over a frame's period around each."""
    at = velocities.time_ns * 1e-9
    centre = np.array(DECK_CENTRE_M)
    true = true_velocities(scene.configuration_at, at - period_s / 2, at + period_s / 2, centre)
    n = len(at)
    block = np.minimum(np.arange(n) * BLOCKS // n, BLOCKS - 1)
    count = np.bincount(block, minlength=BLOCKS)
    scores = {}
    for k, name in enumerate(OUTPUTS):
        square = (velocities.values[:, k] - true[:, k]) ** 2
        for what, sums, finish in (
            ("rms", square, np.sqrt), ("nees", square / velocities.covariance[:, k, k], _as_it_is)
        ):  # fmt: skip
            above = np.bincount(block, weights=sums, minlength=BLOCKS)
            scores[f"{name}_{what}"] = ratio_of_sums(above, count, n, finish)
    return scores


def fit_scores(model: IdentifiedModel, unseen: TrueDrive, drives: Sequence[TrueDrive]) -> dict[str, Score]:
    """Return, output by output, the fit on ``unseen`` over that of the best linear model of ``drives``."""
    scores = {}
    for k, one in enumerate(model.outputs):
        best = best_linear(drives, k, one.estimate.model)
        fits = [
            float(fit_percent(unseen.velocities[:, k : k + 1], answer[:, None])[0])
            for answer in (
                m.response(unseen.inputs, unseen.grid, means=True, from_rest=True) for m in (one.estimate.model, best)
            )
        ]
        scores[f"{one.name}_fit_ratio"] = Score(fits[0] / fits[1], unseen.grid.n)
    return scores


def _as_it_is(values: Array) -> Array:
    return values
