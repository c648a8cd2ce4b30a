"""Lens rows (``mosca.camera.lens_models.row``) whose parameters a bundle adjustment changes."""

from dataclasses import fields

import numpy as np

from mosca.camera.lens_models import fisheye, mosca, opencv
from mosca.camera.lens_models.arrays import radial_slope
from mosca.camera.lens_models.row import BY_LENS as L
from mosca.camera.lens_models.row import FAST, FISHEYE, FOLD, IMAGED, MODEL, MOSCA, OPENCV_FULL, OPENCV_PLAIN, ROW
from mosca.data.arrays import Array
from mosca.data.rig import Lens
from mosca.numba_support.decorators import kernel

__all__ = [
    "FAST", "FOLD", "IMAGED", "MODEL", "OPENCV_PLAIN", "ROW", "L", "image", "influence", "lens_of", "lens_row",
    "set_fold", "set_folds",
]  # fmt: skip

FOLD_SAMPLES = 256
"""Number of steps that bracket the fold, each a third of a degree of the half field of view."""


def lens_row(lens: Lens, free: tuple[str, ...]) -> Array:
    """Return a lens as a row (20,); ``free`` names the parameters that may change."""
    row = np.zeros(ROW)
    values = [getattr(lens, one.name) for one in fields(lens)]
    row[: len(values)] = values
    if lens.model == "opencv":
        seldom = {"k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY"}
        row[MODEL] = OPENCV_FULL if row[9:18].any() or seldom & set(free) else OPENCV_PLAIN
    else:
        row[MODEL] = MOSCA if lens.model == "mosca" else FISHEYE
    set_fold(row)
    return row


def lens_of(row: Array, like: Lens) -> Lens:
    """Return the lens of a row (20,), of the model of ``like``."""
    return type(like)(*(float(x) for x in row[: len(fields(like))]))


@kernel
def set_fold(q):
    """Write where the mapping of lens row q folds back: bracketed by steps of a third of a degree, then bisected."""
    q[FOLD] = np.inf
    last = np.pi if q[MODEL] == FISHEYE else np.pi / 2 - 1e-3
    unit = q[0] if q[MODEL] == MOSCA else 1.0
    low = 0.0
    for k in range(1, FOLD_SAMPLES + 1):
        angle = last * k / FOLD_SAMPLES
        r = angle if q[MODEL] == FISHEYE else unit * np.tan(angle)
        if radial_slope(q, r * r) <= 0:
            high = r * r
            for _ in range(60):
                middle = (low + high) / 2
                if radial_slope(q, middle) > 0:
                    low = middle
                else:
                    high = middle
            q[FOLD] = high
            return
        low = r * r


@kernel
def set_folds(rows):
    """Write the folds of lens rows (n, 20); return whether all have scales above 0, as a lens must."""
    for n in range(rows.shape[0]):
        q = rows[n]
        if not (q[0] > 0 and (q[3] > 0 and q[4] > 0 if q[MODEL] == MOSCA else q[1] > 0)):
            return False
        set_fold(q)
    return True


@kernel(fastmath=FAST)
def image(q, v0, v1, v2, out):
    """Project a direction, camera frame, by lens row q; returns whether it is imaged.

    Fills ``out`` (2, IMAGED or more): for x and y the pixel, its derivatives by the direction (3) and by the lens
    parameters (18). It is one array, since each array argument costs as much as some ten numbers.
    """
    if q[MODEL] == MOSCA:
        return mosca.fast_image(q, v0, v1, v2, out)
    if q[MODEL] == FISHEYE:
        return fisheye.fast_image(q, v0, v1, v2, out)
    return opencv.fast_image(q, v0, v1, v2, out)


@kernel
def influence(q, reach_px):
    """Return the largest motion (18,) of image points ``reach_px`` off the axis per unit of each lens parameter.

    Where the lens does not image such points, half their angle is tried, and so on.
    """
    most, out = np.zeros(18), np.zeros((2, IMAGED))
    focal = q[0] / q[3] if q[MODEL] == MOSCA else q[0]
    for k in range(8):
        angle = reach_px / focal if q[MODEL] == FISHEYE else np.arctan(reach_px / focal)
        a = k * np.pi / 4
        for _ in range(6):
            s = np.sin(angle)
            out[:] = 0.0
            if image(q, s * np.cos(a), s * np.sin(a), np.cos(angle), out):
                for i in range(18):
                    most[i] = max(most[i], np.hypot(out[0, L + i], out[1, L + i]))
                break
            angle /= 2
    return most
