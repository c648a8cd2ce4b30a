"""The runs of a budget: its players, its coalitions, and jobs of runs that share a take."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mosca.errors import InputError
from scenarios.build.cameras import true_rig
from scenarios.spec.scenario import Scenario
from scenarios.spec.switches import SWITCHES, cameras_sources, sources_of, switch
from scenarios.studies.budget.evaluate import (
    DetectedTake,
    Squares,
    believed_rig,
    detected_take,
    evaluate,
    mixed,
    squares_of,
)


@dataclass(frozen=True)
class Player:
    """Sources of error that are on or off together: one source of all cameras, or all sources of one camera."""

    name: str
    told: str
    camera: str | None = None


@dataclass(frozen=True)
class Job:
    """Runs of one seed that one process does: the coalitions ``masks`` of ``players``."""

    spec: Scenario
    """Scenario with this seed."""
    folder: Path
    players: tuple[Player, ...]
    masks: tuple[int, ...]
    metric: str

    def run(self) -> dict[int, Squares]:
        """Return mask -> squares."""
        if self.players[0].camera is not None:
            return self._by_camera()
        found = {}
        takes: dict[tuple[str, ...], DetectedTake] = {}
        for mask in self.masks:
            off = self.off(mask)
            rendered = tuple(name for name in off if switch(name).acts_on != "rig")
            if rendered not in takes:
                takes = {rendered: detected_take(self.spec, self.folder, rendered)}  # one take in memory
            found[mask] = evaluate(self.spec, self.folder, off, self.metric, takes[rendered])
        return found

    def off(self, mask: int) -> tuple[str, ...]:
        """Return the names of the players that a coalition lacks."""
        return tuple(one.name for k, one in enumerate(self.players) if not mask >> k & 1)

    def _by_camera(self) -> dict[int, Squares]:
        sources, names = cameras_sources(self.spec), [one.name for one in self.players]
        on = detected_take(self.spec, self.folder, ())
        off = detected_take(self.spec, self.folder, sources, names)
        believed = believed_rig(self.spec, self.folder, ())
        return {
            mask: squares_of(self.spec, mixed(on, off, self.off(mask)), believed, self.metric) for mask in self.masks
        }


def check_budget(spec: Scenario, where: Path) -> None:
    """Raise InputError where no budget can be made for a scenario."""
    for table, has in {
        "continuous": spec.continuous is not None,
        "zone": bool(spec.zone),
        "flight": spec.flight is not None,
        "self_orientation": spec.self_orientation is not None,
        "pipeline.watch": spec.pipeline.watch,
    }.items():
        if has:
            more = "; its run has a budget of its own" if table == "self_orientation" else ""
            raise InputError(f"{where}: budgets are of frame sets and one fixed rig, {table} is given{more}")
    if spec.expect in ("caught", "diagnosed"):
        raise InputError(f"{where}: expect = '{spec.expect}': such a scenario measures nothing; choose another one")
    if any(one.body is not None for one in spec.camera):
        raise InputError(f"{where}: a [[camera]] rides on a body; budgets are of cameras that stand")


def source_players(spec: Scenario, wanted: Sequence[str]) -> tuple[Player, ...]:
    """Return the sources of a scenario as players; ``wanted``: only these. InputError for one that is not on."""
    there = sources_of(spec)
    for name in wanted:
        switch(name)
        if name not in there:
            raise InputError(f"--sources {name}: the scenario does not have it on; it has {', '.join(there)}")
    chosen = [one for one in SWITCHES if one.name in (wanted or there)]
    # sources that need no render of their own are the lowest bits: neighbouring masks then share a take
    chosen.sort(key=lambda one: one.acts_on != "rig")
    return tuple(Player(one.name, one.told) for one in chosen)


def camera_players(spec: Scenario, folder: Path) -> tuple[Player, ...]:
    """Return the cameras of a scenario as players: each with its own sources of error in the take."""
    told = ", ".join(cameras_sources(spec))
    if not told:
        raise InputError("--by camera: no camera of the scenario has a source of error that can be switched off")
    return tuple(Player(name, f"{name}: {told}", name) for name in true_rig(spec, folder).names)


def jobs_of(
    spec: Scenario, folder: Path, players: tuple[Player, ...], masks: Sequence[int], metric: str, seeds: int
) -> list[Job]:
    """Return the jobs, such that runs that share a take are in one job."""
    rig_bits = sum(
        1 << k for k, one in enumerate(players) if one.camera is None and switch(one.name).acts_on == "rig"
    )
    groups: dict[int, list[int]] = {}
    for mask in masks:
        groups.setdefault(mask & ~rig_bits if players[0].camera is None else 0, []).append(mask)
    jobs = []
    for k in range(seeds):
        seeded = spec.model_copy(update={"seed": spec.seed + k})
        jobs += [Job(seeded, folder, players, tuple(group), metric) for group in groups.values()]
    return jobs
