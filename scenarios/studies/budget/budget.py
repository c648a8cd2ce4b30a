"""The budget of a scenario: runs of all coalitions, in processes, and the contributions computed from them."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from reports.budget import Contribution, ErrorBudget, PredictedSquare
from reports.content import budget_content
from reports.margins import SQUARES
from reports.metrics import METRICS as KINDS
from scenarios.run.provenance import provenance
from scenarios.run.worker_processes import spawned_pool
from scenarios.spec.scenario import Scenario
from scenarios.spec.switches import switch
from scenarios.studies.budget.evaluate import REPROJECTION, Squares, believed_rig
from scenarios.studies.budget.intervals import BLOCKS, by_seed_and_block, interval95
from scenarios.studies.budget.plan import Job, Player, camera_players, check_budget, jobs_of, source_players
from scenarios.studies.budget.shapley import MOST_EXACT, Orders, exact_values

Progress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class BudgetSettings:
    """Settings of a budget."""

    metric: str = "position_rms"
    by: str = "source"
    sources: tuple[str, ...] = ()
    """Sources that are switched off; none: all that the scenario has."""
    seeds: int = 3
    seconds: float = 2.0
    orders: int = 32
    """Number of random orders for more than MOST_EXACT players."""
    workers: int = 2


def error_budget(
    spec: Scenario, name: str, path: Path, settings: BudgetSettings, progress: Progress | None = None
) -> ErrorBudget:
    """Return the budget of the scenario ``spec`` in the file ``path``. InputError where it cannot be made."""
    if settings.metric not in SQUARES:
        raise InputError(
            f"--metric {settings.metric}: squares that add up are those of {', '.join(SQUARES)}; name one of them"
        )
    check_budget(spec, path)
    start = time.perf_counter()
    seconds = min(settings.seconds, spec.capture.duration_s)
    short = spec.model_copy(update={"capture": spec.capture.model_copy(update={"duration_s": seconds})})
    if settings.by == "camera":
        if settings.sources:
            raise InputError("--sources goes with --by source; --by camera switches all of a camera's own off")
        players = camera_players(short, path.parent)
    else:
        players = source_players(short, settings.sources)
    orders = Orders.drawn(len(players), settings.orders) if len(players) > MOST_EXACT else None
    masks = list(range(1 << len(players))) if orders is None else orders.masks()
    jobs = jobs_of(short, path.parent, players, masks, settings.metric, settings.seeds)
    runs = _run_all(jobs, settings.workers, progress or (lambda done, of: None))
    measured = {mask: [runs[seed][mask] for seed in sorted(runs)] for mask in masks}
    game = Game(players, measured, orders, _scale(settings.metric))
    content = budget_content(spec.model_dump(mode="json"))
    method = "all coalitions" if orders is None else f"{settings.orders} random orders (SALib)"
    return ErrorBudget(
        name, settings.metric, _unit(settings.metric), settings.by, content,
        str(provenance()["git"]),
        tuple(sorted(runs)), seconds, BLOCKS, *game.total(), *game.remainder(), game.contributions(),
        game.predicted() if settings.by == "source" and settings.metric != REPROJECTION else (),
        method, len(masks) * settings.seeds, round(time.perf_counter() - start, 1),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Game:
    """The measured squares of all coalitions, and the results computed from them."""

    players: tuple[Player, ...]
    runs: Mapping[int, list[Squares]]
    """Mask -> runs of the seeds."""
    orders: Orders | None
    scale: float
    """Metric squared -> unit of the budget."""

    @cached_property
    def values(self) -> dict[int, Array]:
        """Mask -> mean squares (seeds, blocks)."""
        return {mask: self.scale * by_seed_and_block(runs) for mask, runs in self.runs.items()}

    @cached_property
    def shapley(self) -> Array:
        """The Shapley values (players, seeds, blocks)."""
        if self.orders is None:
            return exact_values(self.values, len(self.players))
        return self.orders.values(self.values)

    def total(self) -> tuple[float, tuple[float, float]]:
        """Return the mean square with all sources on, and its interval."""
        found = self.values[(1 << len(self.players)) - 1]
        return float(found.mean()), interval95(found)

    def remainder(self) -> tuple[float, tuple[float, float]]:
        """Return the mean square with all sources off, and its interval."""
        found = self.values[0]
        return float(found.mean()), interval95(found)

    def contributions(self) -> tuple[Contribution, ...]:
        """Return the contribution of each player, the largest first."""
        values, phi = self.values, self.shapley
        every = (1 << len(self.players)) - 1
        more = np.zeros(len(self.players))
        if self.orders is not None:
            more = self.orders.by_salib(lambda mask: float(values[mask].mean()))[1]
        rows = []
        for k, one in enumerate(self.players):
            alone, without = values.get(1 << k), values.get(every ^ 1 << k)
            rows.append(
                Contribution(
                    one.name,
                    one.told,
                    float(phi[k].mean()),
                    interval95(phi[k], float(more[k])),
                    None if alone is None else float((alone - values[0]).mean()),
                    None if without is None else float((values[every] - without).mean()),
                )
            )
        return tuple(sorted(rows, key=lambda one: -one.square))

    def predicted(self) -> tuple[PredictedSquare, ...]:
        """Return mean squares predicted from stated covariances, with the measured ones: random part, calibration."""
        every = self.runs[(1 << len(self.players)) - 1]
        phi = self.shapley
        of_rig = [k for k, one in enumerate(self.players) if switch(one.name).acts_on != "take"]
        of_take = [k for k in range(len(self.players)) if k not in of_rig]
        rows = []
        for told, part, members in (
            ("random part", np.mean([one.random for one in every]), of_take),
            ("calibration and lens", np.mean([one.calibration for one in every]), of_rig),
        ):
            if members:
                measured = phi[members].sum(axis=0)
                rows.append(
                    PredictedSquare(told, self.scale * float(part), float(measured.mean()), interval95(measured))
                )
        return tuple(rows)


def _run_all(jobs: Sequence[Job], workers: int, progress: Progress) -> dict[int, dict[int, Squares]]:
    """Return seed -> mask -> squares of all jobs, done in ``workers`` processes; with 1, in this process."""
    found: dict[int, dict[int, Squares]] = {}

    def take(job: Job, squares: Mapping[int, Squares], done: int) -> None:
        for mask, one in squares.items():
            if not one.weights.sum():
                on = ", ".join(each.name for k, each in enumerate(job.players) if mask >> k & 1) or "nothing"
                raise InputError(
                    f"budget: seed {job.spec.seed}: with {on} on nothing was measured, so there is no error to share "
                    "out; take a longer --seconds, or mend completeness first"
                )
        found.setdefault(job.spec.seed, {}).update(squares)
        progress(done, len(jobs))

    if workers == 1:
        for done, job in enumerate(jobs, start=1):
            take(job, job.run(), done)
        return found
    with spawned_pool(min(workers, len(jobs))) as pool:
        seeded = {job.spec.seed: job for job in jobs}
        # calibrations first: later jobs find them cached, and none waits for that of another job
        list(pool.map(_calibrate, seeded.values()))
        for done, (job, squares) in enumerate(zip(jobs, pool.map(Job.run, jobs), strict=True), start=1):
            take(job, squares, done)
    return found


def _calibrate(job: Job) -> None:
    names = [one.name for one in job.players if one.camera is None and switch(one.name).acts_on == "lens"]
    for off in {(), tuple(names)}:
        believed_rig(job.spec, job.folder, off)


def _scale(metric: str) -> float:
    return 1e6 if KINDS[metric].unit == "m" else 1.0


def _unit(metric: str) -> str:
    unit = KINDS[metric].unit
    return {"m": "mm^2", "1": "1"}.get(unit, f"{unit}^2")
