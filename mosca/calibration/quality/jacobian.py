"""Jacobian of a calibrated rig's projections with respect to the calibration's named parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from mosca.calibration.bundle.layout import POSE_NAMES
from mosca.calibration.bundle.problem import FOCAL
from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration
from mosca.data.rig import Lens, MoscaLens, Rig, principal_distances_px


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Pixels ``xy_px`` (n, 2) of world points with their derivatives.

    ``by_point`` (n, 2, 3) [px/m]; ``by_parameter`` (n, 2, k) of the calibration's parameters ``columns`` (k,).
    """

    xy_px: Array
    by_point: Array
    by_parameter: Array
    columns: Array


def sensitivity(rig: Rig, camera: int, parameters: Sequence[str], points: Array) -> Sensitivity:
    """Return pixels and derivatives of world points (n, 3) [m] in camera number ``camera`` of ``rig``.

    ``parameters``: the calibration's names.
    """
    one = rig.cameras[camera]
    projection = project_with_jacobians(one, points)
    of_lens = [field.name for field in fields(one.lens)]
    chosen, derivatives = [], []
    for k, name in enumerate(parameters):
        whose, _, what = name.rpartition(".")
        if whose == one.name and what in POSE_NAMES:
            derivative = projection.by_pose[:, :, POSE_NAMES.index(what)]
        elif whose == one.name and what in of_lens:
            derivative = projection.by_lens[:, :, of_lens.index(what)]
        elif whose == one.name and what == FOCAL:
            derivative = projection.by_lens[:, :, 0] + projection.by_lens[:, :, 1] * aspect(one.lens)
        else:
            continue
        chosen.append(k)
        derivatives.append(derivative)
    stacked = np.stack(derivatives, axis=2) if derivatives else np.zeros((len(projection.xy_px), 2, 0))
    return Sensitivity(projection.xy_px, projection.by_point, stacked, np.array(chosen, dtype=np.int64))


def aspect(lens: Lens) -> float:
    """Return the ratio of the principal distance in pixel heights to that in pixel widths: 1 for square pixels."""
    fx, fy = principal_distances_px(lens)
    return fy / fx


def own_lens_parameters(name: str, parameters: Sequence[str]) -> tuple[str, ...]:
    """Return the free lens parameters, without the camera's name, that are listed under ``name``."""
    split = [one.rpartition(".") for one in parameters]
    return tuple(what for whose, _, what in split if whose == name and what not in POSE_NAMES)


def sigma_of_principal_distance(calibration: Calibration, camera: int) -> float | None:
    """Return the relative standard deviation of the principal distance; None where it was held."""
    found = principal_distance_column(calibration, camera)
    if found is None:
        return None
    lens = calibration.rig.cameras[camera].lens
    value = lens.c_mm if isinstance(lens, MoscaLens) else lens.fx_px
    return float(np.sqrt(calibration.covariance[found, found]) / value)


def principal_distance_column(calibration: Calibration, camera: int) -> int | None:
    """Return the index of the principal distance of camera number ``camera``; None where it was held."""
    owner = calibration.rig.names[camera]
    for name in ("c_mm", FOCAL, "fx_px"):
        if f"{owner}.{name}" in calibration.parameters:
            return calibration.parameters.index(f"{owner}.{name}")
    return None
