"""Size of the error of a single source that alone gives the mean difference in Z of the Mosca paper's Table 4, 27 mm.

It is computed from the poses' derivatives by the shared parameters of both sides, in the mean over the flight. The
paper does not state which of the field's axes is Z: both the direction towards the field and the height are
evaluated.
"""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import principal_distances_px
from mosca.machines.self_orientation.camera_path import CameraPath
from scenarios.session.self_orientation import SelfOrientation

PAPER_Z_M = 27.2022596e-3
DEPTH, HEIGHT = 2, 1
"""Rows of the field's Z, towards the camera, and Y, up."""


def enough_alone(found: SelfOrientation, rig: CameraPath) -> dict[str, dict[str, float | str]]:
    """Return source -> quantity (``what``), its ``unit``, and its size for 27 mm in ``depth`` and ``height``.

    ``rig``: the rig's poses of the camera with all shared errors.
    """
    own = found.own.path
    f = max(principal_distances_px(found.prepared.camera.lens))
    xyz = found.prepared.told.positions.ravel()
    focal = _sum(own, {f"lens {name}": f for name in ("fx_px", "fy_px", "f_px", "c_mm")})
    names = [name for name in own.shared.names if name.startswith("target ")]
    rows: dict[str, tuple[str, str, Array]] = {
        "lens": ("principal distance", "%", focal / 100),
        "targets": ("scale of the field", "%", _sum(own, dict(zip(names, xyz.tolist(), strict=True))) / 100),
        "clock": ("offset of the clocks", "ms", _sum(rig, {"clock": 1e-3})),
        "lever": ("camera's place on the body", "mm", 1e-3 * _gradient(rig, "lever ", turn=False)),
        "body": ("tilt of the body's axes about its markers' middle", "deg", np.deg2rad(_tilt(found, rig))),
        "field": ("field's place", "mm", 1e-3 * _gradient(rig, "field ", turn=False)),
        "field turn": ("field's rotation", "deg", np.deg2rad(_gradient(rig, "field ", turn=True))),
    }
    return {
        key: {
            "what": what,
            "unit": unit,
            "depth": float(PAPER_Z_M / max(abs(by[DEPTH]), 1e-12)),
            "height": float(PAPER_Z_M / max(abs(by[HEIGHT]), 1e-12)),
        }
        for key, (what, unit, by) in rows.items()
    }


def _sum(path: CameraPath, factors: dict[str, float]) -> Array:
    """Return the mean position error (3,) when parameters change together, each by its factor."""
    assert path.by_parameter is not None
    mean = path.by_parameter.mean(axis=0)[:3]
    total = np.zeros(3)
    for k, name in enumerate(path.shared.names):
        total += factors.get(name, 0.0) * mean[:, k]
    return total


def _tilt(found: SelfOrientation, rig: CameraPath) -> Array:
    """Return the largest mean error (3,) of each coordinate for a body tilt of 1 rad: r x arm of its camera."""
    assert rig.by_parameter is not None
    place = [rig.shared.names.index(f"lever {axis}") for axis in "xyz"]
    rows = rig.by_parameter.mean(axis=0)[:3][:, place]
    return np.asarray(np.linalg.norm(np.cross(found.lever.body_from_camera.translation, rows), axis=1))


def _gradient(path: CameraPath, group: str, *, turn: bool) -> Array:
    """Return the largest mean error (3,) of each coordinate for a unit change of a vector in its worst direction."""
    assert path.by_parameter is not None
    mean = path.by_parameter.mean(axis=0)[:3]
    axes = [
        k for k, name in enumerate(path.shared.names) if name.startswith(group) and (" turn " in f" {name}") == turn
    ]
    return np.asarray(np.linalg.norm(mean[:, axes], axis=1))
