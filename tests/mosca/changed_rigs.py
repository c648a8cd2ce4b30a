"""A calibration's rig with its parameters changed: finite differences for the tests of derivatives."""

from dataclasses import fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.calibration.bundle.layout import POSE_NAMES
from mosca.calibration.bundle.problem import FOCAL
from mosca.calibration.quality.jacobian import aspect
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration
from mosca.data.rig import Camera, Pose, Rig


def changed_rig(calibration: Calibration, change: Array) -> Rig:
    """Return the rig with ``change`` (u,) added to the calibration's parameters: rotations as R exp([w]x)."""
    step = dict(zip(calibration.parameters, np.asarray(change, dtype=float).tolist(), strict=True))
    return Rig(tuple(_changed(camera, step) for camera in calibration.rig.cameras))


def _changed(camera: Camera, step: dict[str, float]) -> Camera:
    pose = np.array([step.get(f"{camera.name}.{name}", 0.0) for name in POSE_NAMES])
    old, lens = camera.world_from_camera, camera.lens
    turned = old.rotation @ Rotation.from_rotvec(pose[:3]).as_matrix()
    values = {f.name: getattr(lens, f.name) + step.get(f"{camera.name}.{f.name}", 0.0) for f in fields(lens)}
    both = step.get(f"{camera.name}.{FOCAL}", 0.0)
    if both:
        values["fy_px"] += both * aspect(lens)
        values["fx_px"] += both
    return replace(camera, lens=replace(lens, **values), world_from_camera=Pose(turned, old.translation + pose[3:]))
