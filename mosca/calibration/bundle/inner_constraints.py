"""Free networks: the datum that a network's own points define (inner constraints, Meissl 1962)."""

import numpy as np

from mosca.calibration.bundle.datum import generators, point_motions
from mosca.calibration.bundle.layout import NormalsLayout
from mosca.calibration.bundle.levenberg_marquardt import Solution
from mosca.calibration.bundle.precision import carry_down, carry_up
from mosca.calibration.bundle.tables import ParameterValues
from mosca.calibration.common.robust_fit import similarity
from mosca.data.arrays import Array
from mosca.errors import CalibrationError


def diagonals(layout: NormalsLayout, matrices: Array) -> Array:
    """Return the diagonal elements of all blocks of ``matrices``, one after the other."""
    dim, at_v = layout.blocks.size, layout.blocks.normals_at
    block = np.repeat(np.arange(len(dim)), dim)
    inside = np.arange(len(block)) - layout.blocks.slope_at[block]
    return np.asarray(matrices[at_v[block] + inside * (dim[block] + 1)])


def undetermined(layout: NormalsLayout, inverse: Array) -> Array:
    """Return which eliminated points and then placements (m + f,) have an undetermined direction."""
    loose = diagonals(layout, inverse) <= 0
    points = 3 * len(layout.members)
    return np.concatenate([loose[:points].reshape(-1, 3).any(axis=1), loose[points:].reshape(-1, 6).any(axis=1)])


def onto_given(layout: NormalsLayout, solution: Solution, given: ParameterValues) -> ParameterValues:
    """Return the network moved so that its datum points neither shift, rotate nor stretch against their given values.

    The motion minimises the sum of the squared distances.
    """
    table, points, placements = solution.descent.state
    chosen = layout.members[~undetermined(layout, solution.inverse)[: len(layout.members)]]
    if len(chosen) < 3:
        raise CalibrationError(f"datum 'points': {len(chosen)} determined points carry it; three at least are wanted")
    target, source = given.points.take(chosen, axis=0), points.take(chosen, axis=0)
    stretch, motion = similarity(source, target, with_scale=solution.motions == 7)

    def carried(x: Array) -> Array:
        return motion.transform(stretch * x)

    table, points, placements = table.copy(), points.copy(), placements.copy()
    own_points = np.concatenate([layout.members, layout.kept])
    of_world = own_points
    if len(placements):
        of_world = own_points[~np.isin(own_points, layout.observations.point[layout.observations.placement >= 0])]
    points[of_world] = carried(points.take(of_world, axis=0))
    for poses in (table, placements):
        poses[:, :9] = (motion.rotation @ poses[:, :9].reshape(-1, 3, 3)).reshape(-1, 9)
        poses[:, 9:12] = carried(poses[:, 9:12])
    return ParameterValues(table, points, placements)


def in_free_network(layout: NormalsLayout, solution: Solution, by_point: Array) -> tuple[Array, Array]:
    """Carry cofactors into the datum of the points (S-transformation, Baarda 1973): x' = x - G (G_d^T G_d)^-1
    G_d^T x_d.

    Points depend on the reduced unknowns by x_p = e - V^-1 W^T x_c, where e has the cofactors V^-1.
    """
    state, mixed, inverse = solution.descent.state, solution.descent.normals.mixed, solution.inverse
    moves = generators(layout, state)[:, : solution.motions]
    point_moves = point_motions(state.points[layout.members])[:, :, : solution.motions]
    mask = ~undetermined(layout, inverse)[: len(layout.members)]
    chosen = np.where(mask[:, None, None], point_moves, 0.0)
    normal = np.einsum("mij,mik->jk", chosen, chosen)
    functional = np.zeros((int(layout.blocks.size.sum()), solution.motions))
    functional[: 3 * len(mask)] = np.linalg.solve(normal, chosen.reshape(-1, solution.motions).T).T
    up, own_part, own = carry_up(layout.blocks, mixed, inverse, layout.index, len(layout.names), functional)
    q_up = solution.cofactors @ up
    common = own + up.T @ q_up
    camera_common = -q_up
    # the points' own part has the cofactors V^-1 with the datum's functional
    down = carry_down(layout.blocks, mixed, inverse, layout.index, np.pad(q_up, ((0, 1), (0, 0))))
    point_common = (own_part + down)[: 3 * len(mask)].reshape(-1, 3, solution.motions)
    reduced_cofactors = (
        solution.cofactors - moves @ camera_common.T - camera_common @ moves.T + moves @ common @ moves.T
    )
    across = point_moves @ np.swapaxes(point_common, 1, 2)
    spread = point_moves @ common @ np.swapaxes(point_moves, 1, 2)
    return reduced_cofactors, by_point - across - np.swapaxes(across, 1, 2) + spread
