"""Datum and determination: the datum defect, and which parameters the data do not determine.

A network without control can shift, rotate and, without a length, stretch as a whole. These seven motions are
known in closed form (``generators``); the reduced normal matrix shows which of them are not fixed.
"""

import numpy as np

from mosca.calibration.bundle.kernels import LENS
from mosca.calibration.bundle.layout import NormalsLayout
from mosca.calibration.bundle.lenses import influence
from mosca.calibration.bundle.priors import LensPrior, Priors, free_lens_parameters
from mosca.calibration.bundle.problem import Problem
from mosca.calibration.bundle.tables import ParameterValues
from mosca.data.arrays import Array
from mosca.errors import CalibrationError

MOTIONS = 7
NOTHING_FIXES = 1e-9
"""Eigenvalue of the normal matrix, scaled to a unit diagonal, below which a common motion changes no residual."""
SINGULAR = 1e-11
"""The same for any direction: below it two unknowns cannot be separated."""
PLAUSIBLE_SHARE = 0.1
"""Plausible a-priori range: a lens parameter moves no image point by more than this share of half the image's
diagonal; a rotation is at most this many rad, a position change at most this share of the distance to the points."""
LEAST_OPEN_SHARE = 0.1
"""Least ratio of the variance along the weak directions to the plausible one for a lens parameter to get a prior."""


def point_motions(points: Array) -> Array:
    """Return the motions (n, 3, 7) of points (n, 3): common shift, small rotation about the world's axes, stretch."""
    motions = np.zeros((len(points), 3, MOTIONS))
    motions[:, :, :3] = np.eye(3)
    x, y, z = points.T
    motions[:, 1, 3], motions[:, 2, 3] = -z, y
    motions[:, 0, 4], motions[:, 2, 4] = z, -x
    motions[:, 0, 5], motions[:, 1, 5] = -y, x
    motions[:, :, 6] = points
    return motions


def placed_points(layout: NormalsLayout, state: ParameterValues, which: slice) -> Array:
    """Return the points in the world [m] that belong to the sorted observations ``which``."""
    _, points, placements = state
    place = points[layout.observations.point[which]]
    if len(placements):
        placement = layout.observations.placement[which]
        on_thing = placement >= 0
        pose = placements[placement[on_thing]]
        turned = np.einsum("nij,nj->ni", pose[:, :9].reshape(-1, 3, 3), place[on_thing])
        place[on_thing] = turned + pose[:, 9:]
    return np.asarray(place)


def generators(layout: NormalsLayout, state: ParameterValues) -> Array:
    """Return the changes (u, 7) of the reduced system's unknowns by the common motions of ``point_motions``."""
    table, points, _ = state
    rotation, position = table[:, :9].reshape(-1, 3, 3), table[:, 9:LENS]
    out = np.zeros((len(layout.names) + 1, MOTIONS))
    cameras = len(table)
    # a rotation of the world about e_k rotates a camera about R^T e_k in its own frame
    out[layout.index[:cameras, :3], 3:6] = np.swapaxes(rotation, 1, 2)
    out[layout.index[:cameras, 3:6]] = point_motions(position)
    if len(layout.kept):
        on_thing = np.isin(layout.kept, layout.observations.point[layout.observations.placement >= 0])
        columns = layout.index[cameras:, :3][~on_thing]
        out[columns] = point_motions(points[layout.kept[~on_thing]])
    # held unknowns have the index -1, which is the last row; it is cut off
    return out[:-1]


def null_generators(scaled: Array, motions: Array) -> Array:
    """Return orthonormal common motions (u, k) that the ``scaled`` normal matrix (u, u) does not fix.

    ``scaled`` has a unit diagonal, ``motions`` (u, 7) are in its scaled unknowns.
    """
    left, sizes, _ = np.linalg.svd(motions / np.maximum(np.linalg.norm(motions, axis=0), 1e-300), full_matrices=False)
    basis = left[:, sizes > 1e-6 * sizes.max(initial=0.0)]
    values, vectors = np.linalg.eigh(basis.T @ scaled @ basis)
    return np.asarray(basis @ vectors[:, values < NOTHING_FIXES])


def check_datum(problem: Problem, loose: int) -> None:
    """Raise CalibrationError where the number of free common motions does not suit the datum."""
    if problem.datum == "points" and loose not in (6, 7):
        raise CalibrationError(
            f"datum 'points': {7 - loose} of shift (3), turn (3) and stretch (1) are fixed already by what is "
            "held or weighted; take the datum 'given', or free all cameras and points"
        )
    if problem.datum == "given" and loose:
        what = "size" if loose == 1 else "place, direction or size"
        raise CalibrationError(
            f"datum 'given': nothing fixes {loose} of the network's 7 common motions ({what}); hold a camera and "
            "give a length, give control points, or take the datum 'points'"
        )


def weak_directions(
    problem: Problem, layout: NormalsLayout, state: ParameterValues, matrix: Array, variance: float, priors: Priors
) -> tuple[tuple[str, ...], Priors]:
    """Return the names of weakly determined unknowns, and a prior for the worst parameter of each lens with any.

    The reduced normal ``matrix`` (u, u) is scaled by each unknown's plausible a-priori standard deviation. An
    eigenvalue below 1 marks a direction that the data, with a ``variance`` of unit weight, determine less well than
    that. CalibrationError where an unknown that is no lens parameter is not determined at all.
    """
    plausible = _plausible(problem, layout, state)
    values, vectors = np.linalg.eigh(matrix * plausible[:, None] * plausible / max(variance, 1e-300))
    # variances along the weak directions, in units of the plausible ones
    open_share = (vectors[:, values < 1] ** 2 / np.maximum(values[values < 1], 1e-300)).sum(axis=1)
    known = {one.column for one in priors}
    weak = [k for k in map(int, np.flatnonzero(open_share > 1)) if k not in known]
    worst: dict[int, LensPrior] = {}
    for column, camera, parameter in free_lens_parameters(layout):
        before = worst.get(camera)
        if column in known or open_share[column] < (
            LEAST_OPEN_SHARE if before is None else open_share[before.column]
        ):
            continue
        value = float(state.cameras[camera, LENS + parameter])
        worst[camera] = LensPrior(column, camera, parameter, value, float(plausible[column]))
    more = tuple(worst.values())
    if len(values) and values[0] < 1 and not more:
        diagonal = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        values, vectors = np.linalg.eigh(matrix / diagonal[:, None] / diagonal)
        if values[0] < SINGULAR:
            loose = ", ".join(layout.names[k] for k in np.argsort(-np.abs(vectors[:, 0]))[:3])
            raise CalibrationError(
                f"the observations do not determine {loose}; observe more points there, or hold it"
            )
    return tuple(layout.names[k] for k in weak), more


def _plausible(problem: Problem, layout: NormalsLayout, state: ParameterValues) -> Array:
    """Return the plausible a-priori standard deviation (u,) of each unknown of the reduced system."""
    table = state.cameras
    out = np.full(len(layout.names) + 1, PLAUSIBLE_SHARE)
    sample = slice(None, None, max(1, len(layout.order) // 1000))
    away = placed_points(layout, state, sample) - table[layout.observations.camera[sample], 9:LENS]
    far = np.linalg.norm(away, axis=1)
    distance = float(np.median(far[np.isfinite(far)]))
    out[layout.index[: len(table), 3:6]] = PLAUSIBLE_SHARE * distance
    out[layout.index[len(table) :, :3]] = PLAUSIBLE_SHARE * distance
    diagonals: list[float] = [float(np.hypot(one.camera.width, one.camera.height)) for one in problem.cameras]
    moves = np.zeros(len(out))
    owners: list[int] = np.unique(layout.lens_places[:, 0]).tolist()
    most = {c: influence(table[c, LENS:], 0.35 * diagonals[c]) for c in owners}
    for k, (c, own, parameter) in enumerate(layout.lens_places.tolist()):
        share = layout.lens_factors[k] * float(most[c][parameter]) / max(PLAUSIBLE_SHARE * diagonals[c] / 2, 1e-12)
        column = layout.index[c, own]
        moves[column] = np.hypot(moves[column], share)
    moving = moves > 0
    out[moving] = 1 / moves[moving]
    return out[:-1]
