"""The search for a layout: CMA-ES over places, directions and lenses, refined by L-BFGS with the analytic gradient.

CMA-ES (Hansen and Ostermeier, Evolutionary Computation 9, 2001) is that of the package ``cma``. A camera is described
by five numbers: the distance along all mounts, put end to end; the height; pan and tilt from the direction to the
volume's centre; and its option. The refinement holds mounts and options.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from mosca.accuracy.planning.layout import STEEPEST_RAD, CameraOption, Layout, MountingPlace, angles_towards
from mosca.accuracy.planning.objective import Objective
from mosca.accuracy.planning.obstacles import distances_to
from mosca.accuracy.planning.views import Softness
from mosca.data.arrays import Array
from mosca.errors import InputError

WIDE = Softness(0.06, 0.08, 0.12)
"""Softness of the global search."""
NARROWING = (Softness(0.03, 0.04, 0.06), Softness(0.012, 0.015, 0.03))
"""Softnesses of the refinement, one after the other."""
STEPS = (0.15, 0.3, 0.25, 0.25, 0.3)
"""First standard deviations: share of all mounts, share of the height, pan, tilt [rad], share of the options."""
PENALTY = 100.0
"""Cost of a missing distance of a metre, which is squared, and of exceeding the money by 100 %."""


@dataclass(frozen=True, eq=False)
class PlacementTask:
    """The task of a search: its objective, the choices and the limits."""

    objective: Objective
    mounts: tuple[MountingPlace, ...]
    options: tuple[CameraOption, ...]
    money: float | None = None
    spacing_m: float = 0.3
    """Least distance of two cameras."""
    keep_out: Array | None = None
    """(b, 9) bodies in which no camera may stand (``mosca.accuracy.planning.obstacles``)."""
    margin_m: float = 0.05
    """Least distance of cameras from these bodies."""

    @property
    def option_rows(self) -> Array:
        """Rows (o, COLUMNS) of the options."""
        return np.array([one.row for one in self.options])

    def hard(self, layout: Layout) -> float:
        """Return the objective of a layout with hard borders of the views, plus the penalty of ``broken``."""
        objective = replace(self.objective, softness=Softness())
        return objective.value(layout.rows(self.mounts, self.option_rows)) + self.broken(layout)[0]

    def broken(self, layout: Layout) -> tuple[float, Array]:
        """Return the penalty for cameras too near to each other or inside bodies and for money, and its slope (n, 3)
        by the cameras' places; the slope leaves out the bodies.
        """
        places = layout.places(self.mounts)
        apart = places[:, None] - places
        distance = np.sqrt((apart**2).sum(axis=2))
        short = np.maximum(0.0, self.spacing_m - distance)
        np.fill_diagonal(short, 0.0)
        cost = PENALTY * 0.5 * float((short**2).sum())
        slope = -2.0 * PENALTY * ((short / np.maximum(distance, 1e-9))[..., None] * apart).sum(axis=1)
        if self.keep_out is not None and len(self.keep_out):
            cost += PENALTY * float((np.maximum(0.0, self.margin_m - distances_to(self.keep_out, places)) ** 2).sum())
        if self.money is not None:
            cost += PENALTY * max(0.0, layout.price(self.options) / self.money - 1.0)
        return cost, slope

    def allowed(self, layout: Layout) -> bool:
        """Return whether a layout keeps within the money and the distances, to a centimetre."""
        cost, _ = self.broken(layout)
        return cost <= PENALTY * 1e-4


def search(
    task: PlacementTask,
    count: int,
    *,
    evaluations: int = 8000,
    seed: int = 1,
    told: Callable[[int, int], None] = lambda done, most: None,
) -> Layout:
    """Return the best layout of ``count`` cameras found; InputError without the package cma.

    Parameters
    ----------
    task
        Objective, choices and limits.
    count
        Number of cameras.
    evaluations
        Number of evaluations of the objective by CMA-ES.
    seed
        Seed of CMA-ES.
    told
        Called with the numbers of evaluations done and wanted.
    """
    try:
        import cma
    except ModuleNotFoundError:
        raise InputError("mosca plan needs the package cma; pip install 'mosca-testbench[plan]'") from None
    coding = _Coding(task, count)
    wide = replace(task.objective, softness=WIDE)
    option_rows = task.option_rows

    def value(x: Array) -> float:
        layout = coding.layout(x)
        return wide.value(layout.rows(task.mounts, option_rows)) + task.broken(layout)[0]

    starts = [coding.start(option) for option in range(len(task.options))]
    start = min(starts, key=value)
    strategy = cma.CMAEvolutionStrategy(
        start,
        1.0,
        {"CMA_stds": coding.steps(), "seed": seed, "verbose": -9, "maxfevals": evaluations, "tolfun": 1e-5},
    )
    done = 0
    best, least = start, value(start)
    while not strategy.stop():
        found = strategy.ask()
        values = [value(x) for x in found]
        strategy.tell(found, values)
        k = int(np.argmin(values))
        if values[k] < least:
            best, least = np.array(found[k]), values[k]
        told(done := min(done + len(found), evaluations), evaluations)
    candidates = [coding.layout(x) for x in (start, best, strategy.result.xfavorite)]
    refined = [refine(task, one) for one in candidates[1:]]
    return min((*candidates, *refined), key=task.hard)


def refine(task: PlacementTask, layout: Layout) -> Layout:
    """Return the layout refined by L-BFGS over directions and places on the mounts; the given one if no worse."""
    n, best = len(layout), layout
    rows, along, up = task.option_rows, *(
        np.array([getattr(task.mounts[k], name) for k in layout.mount]) for name in ("along", "up")
    )  # fmt: skip
    bounds = [(0.0, 1.0)] * (2 * n) + [(None, None), (-STEEPEST_RAD, STEEPEST_RAD)] * n

    def layout_of(x: Array) -> Layout:
        return layout.moved(x[: 2 * n].reshape(n, 2), x[2 * n :].reshape(n, 2))

    for softness in NARROWING:
        objective = replace(task.objective, softness=softness)

        def value(x: Array, objective: Objective = objective) -> tuple[float, Array]:
            one = layout_of(x)
            found, slope = objective.value_and_slope(one.rows(task.mounts, rows))
            cost, pushed = task.broken(one)
            by_place = slope[:, :3] + pushed
            by_share = np.column_stack([(by_place * along).sum(axis=1), (by_place * up).sum(axis=1)])
            return found + cost, np.concatenate([by_share.ravel(), slope[:, 3:].ravel()])

        start = np.concatenate([best.share.ravel(), best.angles.ravel()])
        done = minimize(value, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60})
        best = min(best, layout_of(done.x), key=task.hard)
    return best


class _Coding:
    """Conversion of CMA-ES's vectors (5 n,) to layouts; any values of a vector give a layout."""

    def __init__(self, task: PlacementTask, count: int) -> None:
        self.task, self.count = task, count
        self.length = np.array([max(float(np.linalg.norm(one.along)), 1e-3) for one in task.mounts])
        self.ends = np.cumsum(self.length) / self.length.sum()

    def layout(self, x: Any) -> Layout:
        task, x = self.task, np.asarray(x, dtype=float).reshape(self.count, 5)
        s = x[:, 0] % 1.0
        mount = np.minimum(np.searchsorted(self.ends, s, side="right"), len(self.ends) - 1)
        begins = np.concatenate([[0.0], self.ends[:-1]])
        share = np.column_stack([(s - begins[mount]) / (self.ends - begins)[mount], _folded(x[:, 1])])
        option = np.minimum((_folded(x[:, 4]) * len(task.options)).astype(int), len(task.options) - 1)
        layout = Layout(mount, np.clip(share, 0.0, 1.0), np.zeros((self.count, 2)), option)
        angles = angles_towards(layout.places(task.mounts), task.objective.room.center) + x[:, 2:4]
        angles[:, 1] = np.clip(angles[:, 1], -STEEPEST_RAD, STEEPEST_RAD)
        return layout.moved(layout.share, angles)

    def start(self, option: int) -> Array:
        """Return cameras evenly spaced along the mounts, all with one option, that look at the centre."""
        x = np.full((self.count, 5), 0.0)
        x[:, 0] = (np.arange(self.count) + 0.5) / self.count
        x[:, 1] = 0.5
        x[:, 4] = (option + 0.5) / len(self.task.options)
        return x.ravel()

    def steps(self) -> list[float]:
        """Return the first standard deviations (5 n)."""
        return list(STEPS) * self.count


def _folded(x: Array) -> Array:
    """Return numbers folded into 0 to 1 by reflection at both ends."""
    return np.abs((x + 1.0) % 2.0 - 1.0)


def first_layout(task: PlacementTask, count: int) -> Layout:
    """Return the first layout of the search: cameras evenly spaced, the best option for all."""
    coding = _Coding(task, count)
    layouts = [coding.layout(coding.start(option)) for option in range(len(task.options))]
    return min(layouts, key=task.hard)
