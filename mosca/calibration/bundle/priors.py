"""A-priori observations of the unknowns of the reduced system: lenses, camera poses, kept points."""

from dataclasses import dataclass

import numpy as np

from mosca.calibration.bundle.kernels import LENS
from mosca.calibration.bundle.layout import NormalsLayout
from mosca.calibration.bundle.problem import Problem
from mosca.calibration.bundle.rotations import observed_pose
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


def lens_priors(problem: Problem, layout: NormalsLayout) -> Priors:
    """Return the priors that the problem states of lens parameters."""
    found = []
    for column, camera, parameter, name in free_lens_parameters(problem, layout):
        if name in problem.cameras[camera].priors:
            value, sigma = problem.cameras[camera].priors[name]
            found.append(LensPrior(column, camera, parameter, value, sigma))
    return tuple(found)


def free_lens_parameters(problem: Problem, layout: NormalsLayout) -> list[tuple[int, int, int, str]]:
    """Return column, camera, parameter and name of each free lens parameter; of "f_px" the parameter is fx."""
    found = []
    seen: set[int] = set()
    for camera, place, parameter in layout.lens_places:
        column = int(layout.index[camera, place])
        if column not in seen:
            seen.add(column)
            found.append((column, int(camera), int(parameter), problem.cameras[camera].free[place - 6]))
    return found


def pulls(
    problem: Problem, layout: NormalsLayout, priors: Priors, state: ParameterValues
) -> tuple[tuple[Array, Array] | None, float]:
    """Return normal matrix (u, u) and slope (u,) of all a-priori observations, and its cost; None if nothing is."""
    weighted = [c for c, one in enumerate(problem.cameras) if any(0 < sigma < np.inf for sigma in one.pose_sigma)]
    information = problem.points.information
    if not (priors or weighted or len(layout.kept_rods) or (len(layout.kept) and information is not None)):
        return None, 0.0
    cameras, points, _ = state
    unknowns = len(layout.names)
    normals, slope, cost = np.zeros((unknowns, unknowns)), np.zeros(unknowns), 0.0
    for one in priors:
        residual = (cameras[one.camera, LENS + one.parameter] - one.value) / one.sigma
        normals[one.column, one.column] += 1 / one.sigma**2
        slope[one.column] += residual / one.sigma
        cost += residual**2
    for c in weighted:
        sigma = np.array(problem.cameras[c].pose_sigma)
        pose = problem.cameras[c].camera.world_from_camera
        own_normals, own_slope = np.zeros((6, 6)), np.zeros(6)
        weight = np.divide(1.0, sigma, out=np.zeros(6), where=sigma > 0)
        given = np.concatenate([pose.rotation.ravel(), pose.translation])
        cost += observed_pose(cameras[c], given, weight, own_normals, own_slope)
        free = np.flatnonzero(layout.index[c, :6] >= 0)
        columns = layout.index[c, free]
        normals[np.ix_(columns, columns)] += own_normals[np.ix_(free, free)]
        slope[columns] += own_slope[free]
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
    """Return how many observations beside image points the adjustment has: lengths and a-priori values."""
    poses = sum(0 < sigma < np.inf for one in problem.cameras for sigma in one.pose_sigma)
    lengths = len(layout.known.distances) + len(layout.kept_rods)
    placements = int((layout.known.pose_weight[layout.placed] > 0).sum()) if layout.known.pose_weight.size else 0
    points = 0
    if problem.points.information is not None:
        own = np.concatenate([layout.members, layout.kept])
        ranks = np.linalg.matrix_rank(problem.points.information[own], hermitian=True) if len(own) else [0]
        points = int(np.sum(ranks))
    return len(priors) + poses + lengths + placements + points
