"""Lens models over arrays of pixels and directions, and the choice of the model that a lens row names."""

from dataclasses import astuple
from functools import lru_cache

import numpy as np

from mosca.camera.lens_models import fisheye, mosca, opencv
from mosca.camera.lens_models.row import (
    BY_DIRECTION,
    BY_LENS,
    FISHEYE,
    FOLD,
    IMAGED,
    MODEL,
    MOSCA,
    OPENCV_FULL,
    RAY_ROW,
    TILT,
    TILTED,
    UNTILT,
)
from mosca.data.arrays import Array
from mosca.data.rig import FisheyeLens, Lens, MoscaLens
from mosca.numba_support.copying import copy_rows
from mosca.numba_support.decorators import inlined_step, kernel, step


@lru_cache(maxsize=256)
def ray_row(lens: Lens) -> Array:
    """Return a lens as a row (RAY_ROW,) for ``direction_of`` and ``image_of``; not to be written to."""
    row = np.zeros(RAY_ROW)
    values = astuple(lens)
    row[: len(values)] = values
    if isinstance(lens, MoscaLens):
        row[FOLD], row[MODEL] = mosca.fold_mm2(lens), MOSCA
    elif isinstance(lens, FisheyeLens):
        row[FOLD], row[MODEL] = fisheye.fold_rad2(lens), FISHEYE
    else:
        row[FOLD], row[MODEL] = opencv.fold_r2(lens), OPENCV_FULL
        row[TILTED] = float(lens.tauX != 0 or lens.tauY != 0)
        tilt = opencv.tilt(lens.tauX, lens.tauY)
        row[TILT:UNTILT], row[UNTILT:RAY_ROW] = tilt.ravel(), np.linalg.inv(tilt).ravel()
    return row


@inlined_step
def direction_of(q, u, v, d, g):
    """Fill the unit direction ``d`` (3,) of a pixel and d pixel / d direction ``g`` (2, 3); False without one."""
    if q[MODEL] == MOSCA:
        return mosca.direction(q, u, v, d, g)
    if q[MODEL] == FISHEYE:
        return fisheye.direction(q, u, v, d, g)
    return opencv.direction(q, u, v, d, g)


@step
def image_of(q, v0, v1, v2, out):
    """Project a direction: fill ``out`` (2, IMAGED or more) and return whether the lens images it."""
    if q[MODEL] == MOSCA:
        return mosca.image(q, v0, v1, v2, out)
    if q[MODEL] == FISHEYE:
        return fisheye.image(q, v0, v1, v2, out)
    return opencv.image(q, v0, v1, v2, out)


@step
def radial_slope(q, s):
    """Return the slope of the radial mapping at the squared radius or angle s; its first zero is the fold."""
    if q[MODEL] == MOSCA:
        return mosca.radial_slope(q, s)
    if q[MODEL] == FISHEYE:
        return fisheye.radial_slope(q, s)
    return opencv.radial_slope(q, s)


def directions(lens: Lens, xy_px: Array) -> tuple[Array, Array]:
    """Return the unit directions (n, 3) of pixels (n, 2), camera frame, and d pixel / d direction (n, 2, 3).

    NaN where no light comes from; a Mosca lens, whose directions have a closed form, also gives some beyond its fold.
    """
    xy = np.array(xy_px, dtype=float).reshape(-1, 2)
    found, slope = np.empty((len(xy), 3)), np.empty((len(xy), 2, 3))
    _directions(ray_row(lens), xy, found, slope)
    return found, slope


def pixels(lens: Lens, directions: Array) -> tuple[Array, Array, Array]:
    """Return pixels (n, 2) of directions (n, 3), d pixel / d direction (n, 2, 3) and d pixel / d lens (n, 2, p).

    Directions may have any length. The lens's parameters p are in the order of the dataclass's fields. NaN where the
    lens does not image the direction: behind the camera, or beyond the radius where the model's radial mapping folds
    back.
    """
    v = np.array(directions, dtype=float).reshape(-1, 3)
    found = np.full((len(v), 2, IMAGED), np.nan)
    _pixels(ray_row(lens), v, found)
    count = len(astuple(lens))
    return found[:, :, 0], found[:, :, BY_DIRECTION:BY_LENS], found[:, :, BY_LENS : BY_LENS + count]


@kernel
def _directions(q, xy, found, slope):
    for n in range(xy.shape[0]):
        if not direction_of(q, xy[n, 0], xy[n, 1], found[n], slope[n]):
            slope[n] = np.nan
            if q[MODEL] != MOSCA:
                found[n] = np.nan


@kernel
def _pixels(q, v, found):
    out = np.zeros((2, IMAGED))
    for n in range(v.shape[0]):
        if image_of(q, v[n, 0], v[n, 1], v[n, 2], out):
            copy_rows(out, found[n])
