"""A-priori observations of the unknowns of the reduced system: lenses, kept points."""

from dataclasses import dataclass

import numpy as np

from mosca.calibration.bundle.kernels import LENS
from mosca.calibration.bundle.layout import NormalsLayout
from mosca.calibration.bundle.problem import Problem
from mosca.calibration.bundle.tables import ParameterValues
from mosca.data.arrays import Array


@dataclass(frozen=True)
class LensPrior:
    """A free lens parameter observed a priori: its column, its camera and parameter, value and sigma."""

    column: int
    camera: int
    parameter: int
    value: float
    sigma: float


Priors = tuple[LensPrior, ...]


def free_lens_parameters(layout: NormalsLayout) -> list[tuple[int, int, int]]:
    """Return column, camera and parameter of each free lens parameter; for "f_px" the parameter is fx."""
    found = []
    seen: set[int] = set()
    for camera, place, parameter in layout.lens_places:
        column = int(layout.index[camera, place])
        if column not in seen:
            seen.add(column)
            found.append((column, int(camera), int(parameter)))
    return found


def pulls(
    problem: Problem, layout: NormalsLayout, priors: Priors, state: ParameterValues
) -> tuple[tuple[Array, Array] | None, float]:
    """Return the normal matrix (u, u) and slope (u,) of all a-priori observations, None without any; and the cost."""
    information = problem.points.information
    if not (priors or len(layout.kept_rods) or (len(layout.kept) and information is not None)):
        return None, 0.0
    cameras, points, _ = state
    unknowns = len(layout.names)
    normals, slope, cost = np.zeros((unknowns, unknowns)), np.zeros(unknowns), 0.0
    for one in priors:
        residual = (cameras[one.camera, LENS + one.parameter] - one.value) / one.sigma
        normals[one.column, one.column] += 1 / one.sigma**2
        slope[one.column] += residual / one.sigma
        cost += residual**2
    if len(layout.kept) and information is not None:
        columns = layout.index[len(problem.cameras) :, :3]
        away = points[layout.kept] - problem.points.xyz[layout.kept]
        pull = np.einsum("pij,pj->pi", information[layout.kept], away)
        normals[columns[:, :, None], columns[:, None, :]] += information[layout.kept]
        slope[columns] += pull
        cost += float(np.sum(pull * away))
    cost += _kept_rods(layout, points, normals, slope)
    return (normals, slope), cost


def _kept_rods(layout: NormalsLayout, points: Array, normals: Array, slope: Array) -> float:
    rods, cost = layout.kept_rods, 0.0
    cameras = len(layout.index) - len(layout.kept)
    first_column = dict(zip(layout.kept.tolist(), layout.index[cameras:, 0].tolist(), strict=True))
    for one, two, wanted, sigma in zip(rods.first, rods.second, rods.length_m, rods.sigma_m, strict=True):
        away = points[one] - points[two]
        length = max(float(np.linalg.norm(away)), 1e-12)
        residual, by = (length - wanted) / sigma, away / length / sigma
        ends = [(first_column[p], sign) for p, sign in ((one, 1.0), (two, -1.0)) if p in first_column]
        for a, sign in ends:
            slope[a : a + 3] += sign * by * residual
            for b, other in ends:
                normals[a : a + 3, b : b + 3] += sign * other * np.outer(by, by)
        cost += residual**2
    return cost


def count(problem: Problem, layout: NormalsLayout, priors: Priors) -> int:
    """Return the number of observations besides image points: lengths and a-priori values."""
    lengths = len(layout.known.distances) + len(layout.kept_rods)
    points = 0
    if problem.points.information is not None:
        own = np.concatenate([layout.members, layout.kept])
        ranks = np.linalg.matrix_rank(problem.points.information[own], hermitian=True) if len(own) else [0]
        points = int(np.sum(ranks))
    return len(priors) + lengths + points
