"""Where everything of a bundle adjustment stands: columns of the reduced system, blocks, slots, sorted
observations.

The tuples of arrays are what the compiled kernels take; see ``kernels`` for groups, blocks and slots.
"""

from dataclasses import dataclass, fields

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mosca.calibration.bundle.problem import FOCAL, Distances, Problem
from mosca.calibration.bundle.reduction import find_runs, pair_table, sorted_by
from mosca.data.arrays import Array, looked_at
from mosca.errors import CalibrationError

POSE_NAMES = ("turn_x_rad", "turn_y_rad", "turn_z_rad", "X_m", "Y_m", "Z_m")
MOST_JOINED_POINTS = 16
"""Points joined by distances up to this number are one block; more stay in the reduced system."""
LANE = 4
"""Groups' columns are padded to multiples of this, so that compiled loops run over whole vectors."""


@dataclass(frozen=True, eq=False)
class NormalsLayout:
    """The structure of a problem.

    ``see``, ``columns``, ``blocks`` and ``known`` are the kernels'; ``order`` (n,) sorts the problem's
    observations into theirs; ``index`` (groups, K) columns of each group in the reduced system, -1 where
    held; ``names`` of these; ``members`` eliminated points, in the order of their blocks; ``placed``
    placements that have a block, in order; ``kept`` points that stay in the reduced system, ``kept_rods``
    distances between these or to held ones; ``lens_places`` (q, 3) group, place in the group's columns and
    lens parameter of every free lens parameter, with ``lens_factors`` (q,).
    """

    see: tuple[Array, ...]
    columns: tuple[Array, ...]
    blocks: tuple[Array, ...]
    known: tuple[Array, ...]
    order: Array
    index: Array
    names: tuple[str, ...]
    members: Array
    placed: Array
    kept: Array
    kept_rods: Distances
    lens_places: Array
    lens_factors: Array
    pair_of: Array
    pairs: int

    @property
    def block_of(self) -> Array:
        """Block (n,) of each sorted observation."""
        return self.see[-1]


def layout_of(problem: Problem) -> NormalsLayout:
    """Return the structure of ``problem``. CalibrationError for a camera that sees nothing or a point without
    start.
    """
    see, n_points = problem.observations, len(problem.points)
    cameras, placements = len(problem.cameras), len(problem.placements)
    _every_camera_sees(problem)
    placement = np.asarray(see.placement)
    on_thing = placement >= 0
    held = np.asarray(problem.points.held)
    observed = np.zeros(n_points, dtype=bool)
    observed[see.point] = True
    rods = _useful(problem)
    kept_mask, label = _kept(problem, on_thing, rods)
    eliminated = ~held & ~kept_mask & (observed | (label >= 0) if len(rods) else observed)
    members = np.flatnonzero(eliminated)
    if len(rods):
        members = members[np.argsort(label[members], kind="stable")]
        opens = np.r_[True, (np.diff(label[members]) != 0) | (label[members][1:] < 0)][: len(members)]
    else:
        opens = np.ones(len(members), dtype=bool)
    # block 0 holds the observations that touch no block; then points, then placements
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
    placed = placed[np.argsort(pose_block[placed])]

    index, names, kept, columns, lens_places, lens_factors = _groups(problem, np.flatnonzero(kept_mask))
    width, groups = index.shape[1], len(index)
    order = sorted_by(block, len(dim), sorted_by(see.camera, cameras, np.arange(len(see))))
    block, camera, point = block[order], see.camera[order], see.point[order]
    kept_rank = np.full(n_points, -1, dtype=np.int64)
    kept_rank[kept] = cameras + np.arange(len(kept))
    kept_group = kept_rank[point]
    slot, kept_slot, slot_key = _slots(block, camera, kept_group, groups)
    slot_block, slot_group = np.divmod(slot_key, groups)
    slot_first = np.searchsorted(slot_block, np.arange(len(dim) + 1))
    runs = find_runs(dim, slot_first, slot_group)
    run = np.repeat(np.arange(len(runs) - 1), np.diff(runs))[block]
    # of a run first all that one camera sees, so that strips are long
    part = np.where(on_thing[order], 0, offset[point])
    own = sorted_by(
        camera * MOST_JOINED_POINTS + part // 3, cameras * MOST_JOINED_POINTS, np.arange(len(see))
    )
    own = sorted_by(run, len(runs), own)
    order, block, camera, point, part = order[own], block[own], camera[own], point[own], part[own]
    slot, kept_slot, kept_group = slot[own], kept_slot[own], kept_group[own]
    blocks = (
        dim,
        np.append(0, np.cumsum(np.bincount(run, minlength=len(runs) - 1))),
        slot_first,
        slot_group,
        np.cumsum(dim * dim) - dim * dim,
        np.cumsum(dim) - dim,
        np.append(0, np.cumsum(dim * np.diff(slot_first) * width)),
        runs,
        np.column_stack([members, home[members], offset[members]]),
    )
    rod_arrays, kept_rods = _rods(rods, home, offset, eliminated, kept_mask, len(dim))
    pair_of, pairs = pair_table(slot_first, slot_group, kept_group, camera, groups)
    information = problem.points.information
    sigma = problem.placements.sigma
    known = (
        problem.points.xyz,
        looked_at(np.zeros((0, 3, 3))) if information is None else information,
        pose_block,
        np.column_stack([problem.placements.rotation.reshape(-1, 9), problem.placements.translation]),
        np.zeros((0, 6)) if sigma is None else 1 / sigma,
        *rod_arrays,
    )
    sorted_see = (
        camera,
        point,
        placement[order],
        see.xy_px.take(order, axis=0),
        1 / np.asarray(see.sigma_px)[order],
        part,
        slot,
        kept_group,
        kept_slot,
        block,
    )
    return NormalsLayout(
        sorted_see, columns, blocks, known, order, index, names, members, placed, kept, kept_rods,
        lens_places, lens_factors, pair_of, pairs,
    )  # fmt: skip


def _alike_together(dim: Array, point_blocks: int, block: Array, camera: Array) -> Array:
    """Return new numbers (blocks,) by which blocks of one size seen by the same cameras follow each other.

    Points stay before placements. Of more than 62 cameras some count as the same, which costs time, nothing
    else.
    """
    seen_by = np.zeros(len(dim), dtype=np.int64)
    np.bitwise_or.at(seen_by, block, np.left_shift(1, camera % 62))
    is_pose = np.arange(len(dim)) > point_blocks
    order = 1 + np.lexsort((seen_by[1:], dim[1:], is_pose[1:]))
    rank = np.zeros(len(dim), dtype=np.int64)
    rank[order] = np.arange(1, len(dim))
    return rank


def _slots(block: Array, camera: Array, kept_group: Array, groups: int) -> tuple[Array, Array, Array]:
    """Return the slots of the cameras and kept points of observations (n,), and each slot's block and group
    as a key, sorted: block times ``groups`` plus group.

    The observations are sorted by block, then by camera. Block 0 has no slots (-1).
    """
    key = block * groups + camera
    static = int(np.searchsorted(block, 1))
    slot, kept_slot = np.full(len(key), -1, dtype=np.int64), np.full(len(key), -1, dtype=np.int64)
    if (kept_group >= 0).any():
        second = np.where(kept_group >= 0, block * groups + kept_group, key)
        slot_key = np.unique(np.concatenate([key[static:], second[static:]]))
        kept_slot[static:] = np.searchsorted(slot_key, second[static:])
        slot[static:] = np.searchsorted(slot_key, key[static:])
        return slot, kept_slot, slot_key
    opens = np.ones(len(key) - static, dtype=bool)
    opens[1:] = key[static + 1 :] != key[static:-1]
    slot[static:] = np.cumsum(opens) - 1
    return slot, kept_slot, key[static:][opens]


def _every_camera_sees(problem: Problem) -> None:
    counts = np.bincount(problem.observations.camera, minlength=len(problem.cameras))
    for one, count in zip(problem.cameras, counts, strict=True):
        if count == 0 and any(sigma == np.inf for sigma in one.pose_sigma):
            raise CalibrationError(
                f"camera '{one.camera.name}': no observation, its pose is not determined; leave it out or hold it"
            )


def _useful(problem: Problem) -> Distances:
    """Return the distances both of whose ends something else places, too.

    A point with one ray and a distance has two places: it would lead astray more than it tells.
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
    """Return the distances within blocks as the kernels take them, and those that touch only kept points."""
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


def _groups(
    problem: Problem, kept: Array
) -> tuple[Array, tuple[str, ...], Array, tuple[Array, ...], Array, Array]:
    """Return the columns of the groups, their names, the kept points, and how lens parameters map to columns."""
    owner = problem.lens_owner()
    most = max((len(problem.cameras[k].free) for k in owner), default=0)
    width = LANE * -(-(6 + most) // LANE)
    cameras = len(problem.cameras)
    index = np.full((cameras + len(kept), width), -1, dtype=np.int64)
    first = np.zeros((cameras, width - 6), dtype=np.int64)
    second, factor = np.zeros((cameras, width - 6), dtype=np.int64), np.zeros((cameras, width - 6))
    count = np.array([len(problem.cameras[k].free) for k in owner], dtype=np.int64)
    names: list[str] = []
    places: list[tuple[int, int, int]] = []
    factors: list[float] = []
    for c, one in enumerate(problem.cameras):
        for k, name in enumerate(POSE_NAMES):
            if one.pose_sigma[k] > 0:
                index[c, k] = len(names)
                names.append(f"{one.camera.name}.{name}")
        if owner[c] != c:
            index[c, 6:] = index[owner[c], 6:]
            continue
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
    columns = (owner, count, first, second, factor)
    return (
        index,
        tuple(names),
        kept,
        columns,
        np.array(places, dtype=np.int64).reshape(-1, 3),
        np.array(factors),
    )
