"""Index layout of the normal equations: columns of the reduced system, blocks, slots, sorted observations.

See ``kernels`` for groups, blocks and slots, ``tables`` for the arrays that the compiled functions take.
"""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mosca.calibration.bundle.problem import FOCAL, Distances, Problem
from mosca.calibration.bundle.reduction import find_runs, pair_table, sorted_by
from mosca.calibration.bundle.tables import EliminatedBlocks, Known, LensColumns, SortedObservations
from mosca.data.arrays import Array, looked_at
from mosca.errors import CalibrationError

POSE_NAMES = ("turn_x_rad", "turn_y_rad", "turn_z_rad", "X_m", "Y_m", "Z_m")
MOST_JOINED_POINTS = 16
"""Up to this number of points joined by distances form one block; more stay in the reduced system."""
LANE = 4
"""Groups' columns are padded to multiples of this, so that compiled loops run over whole vectors."""


@dataclass(frozen=True, eq=False)
class NormalsLayout:
    """The structure of the reduced normal equations of a problem."""

    observations: SortedObservations
    columns: LensColumns
    blocks: EliminatedBlocks
    known: Known
    order: Array
    """(n,) sorts the problem's observations into ``observations``."""
    index: Array
    """(groups, K) columns of each group in the reduced system, -1 where held."""
    names: tuple[str, ...]
    """Names of the unknowns of the reduced system."""
    members: Array
    """Eliminated points, in the order of their blocks."""
    placed: Array
    """Placements that have a block, in the order of their blocks."""
    kept: Array
    """Points that stay in the reduced system."""
    kept_rods: Distances
    """Distances between kept points, or from kept to held points."""
    lens_places: Array
    """(q, 3) of every free lens parameter: group, column within the group, index of the lens parameter."""
    lens_factors: Array
    """(q,) derivative of that lens parameter by the column."""
    pair_of: Array
    pairs: int

    @property
    def block_of(self) -> Array:
        """Block (n,) of each sorted observation."""
        return self.observations.block


class _Assignment(NamedTuple):
    """Which unknowns are eliminated in which block."""

    size: Array
    """(b,) unknowns of each block."""
    block: Array
    """(n,) block of each observation; block 0 is for observations that touch no block."""
    point_block: Array
    """(p,) block of each point."""
    offset: Array
    """(p,) first unknown of each point in its block."""
    members: Array
    placed: Array


def layout_of(problem: Problem) -> NormalsLayout:
    """Return the structure of ``problem``. CalibrationError for a camera that sees nothing or a point without
    starting coordinates.
    """
    see, cameras = problem.observations, len(problem.cameras)
    _every_camera_sees(problem)
    on_thing = np.asarray(see.placement) >= 0
    observed = np.zeros(len(problem.points), dtype=bool)
    observed[see.point] = True
    rods = _useful(problem)
    kept_mask, label = _kept(problem, on_thing, rods)
    held = np.asarray(problem.points.held)
    eliminated = ~held & ~kept_mask & (observed | (label >= 0) if len(rods) else observed)
    assigned = _assigned(problem, eliminated, label, len(rods) > 0)
    groups_of = _groups(problem, np.flatnonzero(kept_mask))
    index, groups = groups_of.index, len(groups_of.index)
    order = sorted_by(assigned.block, len(assigned.size), sorted_by(see.camera, cameras, np.arange(len(see))))
    kept_rank = np.full(len(held), -1, dtype=np.int64)
    kept_rank[groups_of.kept] = cameras + np.arange(len(groups_of.kept))
    slots = _slots(assigned.block[order], see.camera[order], kept_rank[see.point[order]], groups)
    slot_block, slot_group = np.divmod(slots.key, groups)
    slot_first = np.searchsorted(slot_block, np.arange(len(assigned.size) + 1))
    runs = find_runs(assigned.size, slot_first, slot_group)
    run = np.repeat(np.arange(len(runs) - 1), np.diff(runs))[assigned.block[order]]
    # within a run, observations are sorted by camera, so that batches are long
    part = np.where(on_thing[order], 0, assigned.offset[see.point[order]])
    own = sorted_by(
        see.camera[order] * MOST_JOINED_POINTS + part // 3, cameras * MOST_JOINED_POINTS, np.arange(len(see))
    )
    own = sorted_by(run, len(runs), own)
    order = order[own]
    observations = SortedObservations(
        see.camera[order], see.point[order], np.asarray(see.placement)[order], see.xy_px.take(order, axis=0),
        1 / np.asarray(see.sigma_px)[order], part[own], slots.slot[own], kept_rank[see.point[order]],
        slots.kept_slot[own], assigned.block[order]
    )  # fmt: skip
    first_observation = np.append(0, np.cumsum(np.bincount(run, minlength=len(runs) - 1)))
    blocks = _blocks(assigned, first_observation, slot_first, slot_group, runs, index.shape[1])
    known, kept_rods = _known(problem, rods, assigned, eliminated, kept_mask)
    pair_of, pairs = pair_table(slot_first, slot_group, observations.kept_group, observations.camera, groups)
    return NormalsLayout(
        observations, groups_of.columns, blocks, known, order, index, groups_of.names, assigned.members,
        assigned.placed, groups_of.kept, kept_rods, groups_of.lens_places, groups_of.lens_factors, pair_of, pairs
    )  # fmt: skip


def _assigned(problem: Problem, eliminated: Array, label: Array, joined: bool) -> _Assignment:
    """Return the blocks: points first, those ``joined`` by distances together (``label``), then placements."""
    see, n_points, placements = problem.observations, len(problem.points), len(problem.placements)
    placement = np.asarray(see.placement)
    on_thing = placement >= 0
    members = np.flatnonzero(eliminated)
    if joined:
        members = members[np.argsort(label[members], kind="stable")]
        opens = np.r_[True, (np.diff(label[members]) != 0) | (label[members][1:] < 0)][: len(members)]
    else:
        opens = np.ones(len(members), dtype=bool)
    home, offset = np.zeros(n_points, dtype=np.int64), np.zeros(n_points, dtype=np.int64)
    home[members] = np.cumsum(opens)
    starts = np.flatnonzero(opens)
    sizes = np.diff(np.r_[starts, len(members)])
    offset[members] = 3 * (np.arange(len(members)) - np.repeat(starts, sizes))
    placed = np.flatnonzero(np.bincount(placement[on_thing], minlength=placements))
    pose_block = np.zeros(placements, dtype=np.int64)
    pose_block[placed] = 1 + len(sizes) + np.arange(len(placed))
    dim = np.concatenate([[0], 3 * sizes, np.full(len(placed), 6)]).astype(np.int64)
    block = np.where(on_thing, pose_block[placement], home[see.point]) if placements else home[see.point]
    rank = _alike_together(dim, len(sizes), block, see.camera)
    block, dim[rank] = rank[block], dim.copy()
    home, pose_block = rank[home], rank[pose_block]
    members = members[np.argsort(home[members] * (3 * MOST_JOINED_POINTS) + offset[members])]
    return _Assignment(dim, block, home, offset, members, placed[np.argsort(pose_block[placed])])


def _blocks(
    assigned: _Assignment, first_observation: Array, slot_first: Array, slot_group: Array, runs: Array, width: int
) -> EliminatedBlocks:
    """Return where the parts of the blocks begin; ``width``: columns of a group."""
    dim, members = assigned.size, assigned.members
    return EliminatedBlocks(
        dim,
        first_observation,
        slot_first,
        slot_group,
        np.cumsum(dim * dim) - dim * dim,
        np.cumsum(dim) - dim,
        np.append(0, np.cumsum(dim * np.diff(slot_first) * width)),
        runs,
        np.column_stack([members, assigned.point_block[members], assigned.offset[members]]),
    )


def _known(
    problem: Problem, rods: Distances, assigned: _Assignment, eliminated: Array, kept: Array
) -> tuple[Known, Distances]:
    """Return the a-priori values of the blocks, and the distances that touch only kept points."""
    rod_arrays, kept_rods = _rods(rods, assigned.point_block, assigned.offset, eliminated, kept, len(assigned.size))
    information = problem.points.information
    known = Known(
        problem.points.xyz, looked_at(np.zeros((0, 3, 3))) if information is None else information, *rod_arrays
    )
    return known, kept_rods


def _alike_together(dim: Array, point_blocks: int, block: Array, camera: Array) -> Array:
    """Return new numbers (blocks,) that make blocks of one size seen by the same cameras consecutive.

    Points stay before placements. With more than 62 cameras some count as the same; this only costs time.
    """
    seen_by = np.zeros(len(dim), dtype=np.int64)
    np.bitwise_or.at(seen_by, block, np.left_shift(1, camera % 62))
    is_pose = np.arange(len(dim)) > point_blocks
    order = 1 + np.lexsort((seen_by[1:], dim[1:], is_pose[1:]))
    rank = np.zeros(len(dim), dtype=np.int64)
    rank[order] = np.arange(1, len(dim))
    return rank


class _Slots(NamedTuple):
    """Slots of observations."""

    slot: Array
    """(n,) slot of the camera, -1 in block 0."""
    kept_slot: Array
    """(n,) slot of the kept point, -1 for none."""
    key: Array
    """(slots,) block times the number of groups plus group, ascending."""


def _slots(block: Array, camera: Array, kept_group: Array, groups: int) -> _Slots:
    """Return the slots of the cameras and kept points of observations sorted by block, then by camera."""
    key = block * groups + camera
    static = int(np.searchsorted(block, 1))
    slot, kept_slot = np.full(len(key), -1, dtype=np.int64), np.full(len(key), -1, dtype=np.int64)
    if (kept_group >= 0).any():
        second = np.where(kept_group >= 0, block * groups + kept_group, key)
        slot_key = np.unique(np.concatenate([key[static:], second[static:]]))
        kept_slot[static:] = np.searchsorted(slot_key, second[static:])
        slot[static:] = np.searchsorted(slot_key, key[static:])
        return _Slots(slot, kept_slot, slot_key)
    opens = np.ones(len(key) - static, dtype=bool)
    opens[1:] = key[static + 1 :] != key[static:-1]
    slot[static:] = np.cumsum(opens) - 1
    return _Slots(slot, kept_slot, key[static:][opens])


def _every_camera_sees(problem: Problem) -> None:
    counts = np.bincount(problem.observations.camera, minlength=len(problem.cameras))
    for one, count in zip(problem.cameras, counts, strict=True):
        if count == 0 and not one.held:
            raise CalibrationError(
                f"camera '{one.camera.name}': no observation, its pose is not determined; leave it out or hold it"
            )


def _useful(problem: Problem) -> Distances:
    """Return the distances whose two ends are also determined by other observations.

    A point with one ray and one distance has two solutions.
    """
    rods = problem.distances
    if len(rods) == 0:
        return rods
    known = np.bincount(problem.observations.point, minlength=len(problem.points)) >= 2
    known |= problem.points.held
    if problem.points.information is not None:
        known = known | (problem.points.information != 0).any(axis=(1, 2))
    both = known[rods.first] & known[rods.second]
    return Distances(rods.first[both], rods.second[both], rods.length_m[both], rods.sigma_m[both])


def _kept(problem: Problem, on_thing: Array, rods: Distances) -> tuple[Array, Array]:
    """Return which points (p,) stay in the reduced system, and the label (p,) of points joined by distances."""
    see, held = problem.observations, np.asarray(problem.points.held)
    kept = np.zeros(len(held), dtype=bool)
    kept[see.point[on_thing]] = True
    kept &= ~held
    label = np.full(len(held), -1, dtype=np.int64)
    if len(rods):
        free = ~held[rods.first] & ~held[rods.second]
        pairs = (np.ones(int(free.sum())), (rods.first[free], rods.second[free]))
        component = connected_components(coo_array(pairs, shape=(len(held), len(held))), directed=False)[1]
        joined = np.union1d(rods.first, rods.second)
        joined = joined[~held[joined]]
        label[joined] = component[joined]
        size = np.bincount(label[joined], minlength=len(held))
        stays = size > MOST_JOINED_POINTS
        stays[label[kept & (label >= 0)]] = True
        kept[joined] |= stays[label[joined]]
    if not np.isfinite(problem.points.xyz[kept]).all():
        first = int(np.flatnonzero(kept & ~np.isfinite(problem.points.xyz).all(axis=1))[0])
        raise CalibrationError(
            f"point {first}: it is seen on a placed thing, or joined to many others, and has no starting "
            "coordinates; give some"
        )
    return kept, label


def _rods(
    rods: Distances, home: Array, offset: Array, eliminated: Array, kept: Array, n_blocks: int
) -> tuple[tuple[Array, ...], Distances]:
    """Return the distances within blocks in the kernels' form, and those that touch only kept points."""
    if len(rods) == 0:
        first = np.zeros(n_blocks + 1, dtype=np.int64)
        return (first, np.zeros((0, 4), dtype=np.int64), np.zeros((0, 2))), rods
    inside = eliminated[rods.first] | eliminated[rods.second]
    of_block = np.where(eliminated[rods.first], home[rods.first], home[rods.second])
    chosen = np.flatnonzero(inside)
    chosen = chosen[np.argsort(of_block[chosen], kind="stable")]
    one, two = rods.first[chosen], rods.second[chosen]
    at = [np.where(eliminated[p], offset[p], -1) for p in (one, two)]
    arrays = (
        np.searchsorted(of_block[chosen], np.arange(n_blocks + 1)),
        np.column_stack([one, two, *at]),
        np.column_stack([rods.length_m[chosen], 1 / rods.sigma_m[chosen]]),
    )
    rest = ~inside & (kept[rods.first] | kept[rods.second])
    return arrays, Distances(rods.first[rest], rods.second[rest], rods.length_m[rest], rods.sigma_m[rest])


@dataclass(frozen=True, eq=False)
class _Groups:
    """Columns of the groups; the fields are those of ``NormalsLayout``."""

    index: Array
    names: tuple[str, ...]
    kept: Array
    columns: LensColumns
    lens_places: Array
    lens_factors: Array


def _groups(problem: Problem, kept: Array) -> _Groups:
    """Return the columns of the groups, their names, the kept points, and how lens parameters map to columns."""
    most = max((len(one.free) for one in problem.cameras), default=0)
    width = LANE * -(-(6 + most) // LANE)
    cameras = len(problem.cameras)
    index = np.full((cameras + len(kept), width), -1, dtype=np.int64)
    first = np.zeros((cameras, width - 6), dtype=np.int64)
    second, factor = np.zeros((cameras, width - 6), dtype=np.int64), np.zeros((cameras, width - 6))
    count = np.array([len(one.free) for one in problem.cameras], dtype=np.int64)
    names: list[str] = []
    places: list[tuple[int, int, int]] = []
    factors: list[float] = []
    for c, one in enumerate(problem.cameras):
        if not one.held:
            index[c, :6] = len(names) + np.arange(6)
            names += [f"{one.camera.name}.{name}" for name in POSE_NAMES]
        lens = one.camera.lens
        of_lens = [f.name for f in fields(lens)]
        for k, name in enumerate(one.free):
            index[c, 6 + k] = len(names)
            names.append(f"{one.camera.name}.{name}")
            if name == FOCAL:
                ratio = getattr(lens, "fy_px") / getattr(lens, "fx_px")  # noqa: B009  (two of three lenses have it)
                first[c, k], second[c, k], factor[c, k] = 0, 1, ratio
                places += [(c, 6 + k, 0), (c, 6 + k, 1)]
                factors += [1.0, ratio]
            else:
                first[c, k] = of_lens.index(name)
                places.append((c, 6 + k, of_lens.index(name)))
                factors.append(1.0)
    for k, point in enumerate(kept):
        index[cameras + k, :3] = len(names) + np.arange(3)
        names += [f"point {point}.{axis}_m" for axis in "XYZ"]
    columns = LensColumns(count, first, second, factor)
    of_lenses = np.array(places, dtype=np.int64).reshape(-1, 3)
    return _Groups(index, tuple(names), kept, columns, of_lenses, np.array(factors))
