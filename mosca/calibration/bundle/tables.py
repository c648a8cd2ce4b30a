"""Tables of a bundle adjustment that its compiled functions take: named tuples of arrays.

See ``kernels`` for groups, blocks and slots. "Sorted" observations are the problem's in the order of ``layout``.
"""

from typing import NamedTuple

from mosca.data.arrays import Array


class ParameterValues(NamedTuple):
    """Values of all unknowns and of what is held."""

    cameras: Array
    """(c, 32): rotation world_from_camera (9, row by row), position (3) [m], lens row (20, ``lenses``)."""
    points: Array
    """(p, 3) [m]."""
    placements: Array
    """(f, 12): rotation world_from_thing (9, row by row), position (3) [m]."""


class SortedObservations(NamedTuple):
    """Image points, sorted by run of blocks, then by camera."""

    camera: Array
    """(n,) index of the camera."""
    point: Array
    """(n,) index of the object point."""
    placement: Array
    """(n,) index of the placement, -1 for a point of the world."""
    xy_px: Array
    """(n, 2) [px]."""
    weight: Array
    """(n,) 1 / sigma [1/px], 0 where left out."""
    offset: Array
    """(n,) first unknown of the point within its block, 0 for a placement."""
    slot: Array
    """(n,) slot of the camera's group, -1 where no block is touched."""
    kept_group: Array
    """(n,) group of a point that stays in the reduced system, -1 otherwise."""
    kept_slot: Array
    """(n,) slot of that group, -1 where no block is touched."""
    block: Array
    """(n,) block, 0 where none is touched."""


class LensColumns(NamedTuple):
    """How the free lens parameters of each camera's group follow from its lens row."""

    free: Array
    """(c,) number of free lens parameters."""
    first: Array
    """(c, k) lens parameter of each column."""
    second: Array
    """(c, k) a second lens parameter that changes with the first."""
    factor: Array
    """(c, k) ratio of the second's change to the first's; 0 for none."""


class EliminatedBlocks(NamedTuple):
    """Blocks of eliminated unknowns and where their parts begin in flat arrays."""

    size: Array
    """(b,) number of unknowns; block 0 has none."""
    first_observation: Array
    """(runs + 1,) first sorted observation of each run."""
    first_slot: Array
    """(b + 1,) first slot of each block."""
    slot_group: Array
    """(slots,) group of each slot."""
    normals_at: Array
    """(b,) beginning of a block's normal matrix, and of its inverse and cofactors."""
    slope_at: Array
    """(b,) beginning of a block's slope and step."""
    mixed_at: Array
    """(b + 1,) beginning of a block's mixed part with its groups."""
    runs: Array
    """(runs + 1,) first block of each run (``reduction``)."""
    members: Array
    """(m, 3) of each eliminated point: its index, block and offset in the block."""


class Known(NamedTuple):
    """A-priori values of eliminated points, and distances within blocks."""

    points: Array
    """(p, 3) given coordinates [m]."""
    information: Array
    """(p, 3, 3) inverse covariance of these [1/m^2]; empty where none is weighted."""
    first_distance: Array
    """(b + 1,) first distance of each block."""
    distances: Array
    """(d, 4) both points and their offsets in the block, -1 where held."""
    distance_weight: Array
    """(d, 2) length [m] and 1 / sigma [1/m]."""


class Loss(NamedTuple):
    """Robust loss of a squared residual."""

    kind: int
    """LEAST_SQUARES, HUBER or CAUCHY (``kernels``)."""
    scale2: float
    """Square of the scale, in a-priori standard deviations."""


class NormalEquations(NamedTuple):
    """Normal equations at a state."""

    groups: Array
    """(g, K, K) U, of each group."""
    cross: Array
    """(pairs, K, K) U between two groups."""
    group_slope: Array
    """(g, K) gradient of the groups' unknowns."""
    mixed: Array
    """(flat) W^T, run by run."""
    blocks: Array
    """(flat) V, block by block."""
    block_slope: Array
    """(flat) gradient of the blocks' unknowns."""
    pair_of: Array
    """(g, g) index of each pair of groups in ``cross``, -1 for none."""
    residuals_px: Array
    """(n, 2) projected minus observed of the sorted observations [px], NaN where not imaged."""


class ReducedInverse(NamedTuple):
    """Inverse of the reduced normal equations beside the inverse of the blocks."""

    cofactors: Array
    """(u + 1, u + 1) of the reduced system, last row and column zero."""
    group_columns: Array
    """(g, K) columns of each group in it."""
    blocks: Array
    """(flat) V^-1."""
