"""Causes of rays that do not meet: each is a linear model of image displacements (``mosca.clinic.misfit``)."""

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from mosca.calibration.quality.limits import QualityLimits
from mosca.clinic.causes import Diagnosis
from mosca.clinic.misfit import Fit, Residuals, fit
from mosca.data.arrays import Array
from mosca.data.rig import Rig, principal_point_px
from mosca.diagnostics.camera_health import HealthSettings

UNIT_WEIGHT = QualityLimits().unit_weight
"""Residuals up to this factor times the stated noise are no fault."""
MOVED_PX = QualityLimits().moved_px
"""Displacement of images below which no geometry is blamed."""
LATE_S = HealthSettings().late_s
"""Delay below which no clock is blamed."""
WHOLE = 0.15
"""A delay that differs from whole periods by less than this share of a period is attributed to wrong pairing."""
EXPLAINED = 0.5
"""Share of the misfit that a cause must explain."""
STEPS = 12
"""Number of instants at which a sudden change is tested."""
MOST_CAMERAS = 8
"""Largest number of cameras for which groups of cameras are tested."""

Model = tuple[str, int | None, str, Array, int]
"""Code, camera, kind, design (n, c, 2, p), and the number of models alike, of which the best is taken."""


def geometry_causes(residuals: Residuals, rig: Rig, period_s: float, alpha: float) -> list[Diagnosis]:
    """Return the causes that explain the misfit of the rays, likeliest first; none where there is no misfit.

    ``period_s``: frame period [s]; ``alpha``: chance of a false alarm of each cause.
    """
    if len(residuals.rest) == 0 or residuals.unit_weight <= UNIT_WEIGHT:
        return []
    if residuals.unit_weight > UNIT_WEIGHT * residuals.better_half:
        return []  # a fault of the rig shows in all markers; only a few have this misfit
    excess = residuals.squares() - residuals.freedom
    best: dict[str, Diagnosis] = {}
    for code, camera, kind, design, searched in models(residuals, rig):
        found = fit(residuals, design, searched)
        explained = (residuals.squares() - found.squares) / excess
        if found.p_value > alpha or explained < EXPLAINED:
            continue
        one = _diagnosis(code, camera, kind, found, residuals, rig, period_s, explained)
        if one is not None and (one.code not in best or one.score < best[one.code].score):
            best[one.code] = one
    return sorted(best.values(), key=lambda one: one.score)


def models(residuals: Residuals, rig: Rig) -> Iterator[Model]:
    """Yield all models of displaced images."""
    cameras = len(rig.cameras)
    time_s = residuals.observations.time_s
    span = max(float(time_s.max() - time_s.min()), 1e-9)
    t = (time_s - time_s.min()) / span
    field = _fields(residuals, rig)
    edges = np.linspace(0.1, 0.9, STEPS)
    for k in range(cameras):
        only = np.zeros(cameras)
        only[k] = 1.0
        pose = residuals.by_pose * only[None, :, None, None]
        delay = residuals.flow[..., None] * only[None, :, None, None]
        yield "camera-moved", k, "still", pose, cameras
        yield "camera-moved", k, "creeps", pose[..., :3] * t[:, None, None, None], cameras
        yield "sync-lost", k, "still", delay, cameras
        yield "sync-lost", k, "slope", delay * t[:, None, None, None], cameras
        yield "wrong-lens", k, "one", field * only[None, :, None, None], cameras
        for edge in edges:
            after = (t > edge).astype(float)[:, None, None, None]
            yield "camera-moved", k, f"step {edge * span:.3g}", pose[..., :3] * after, cameras * STEPS
            yield "sync-lost", k, f"step {edge * span:.3g}", delay * after, cameras * STEPS
    yield "wrong-lens", None, "all", _each(field), 1
    yield "other-resolution", None, "all", _zoom(residuals, rig), 1
    yield "other-resolution", None, "each", _each(_zoom(residuals, rig)), 1
    rows = _rows(residuals, rig)[..., None]
    yield "rolling-shutter", None, "all", rows, 1
    yield "rolling-shutter", None, "each", _each(rows), 1
    yield "sync-lost", None, "each", _each(residuals.flow[..., None]), 1
    turns = _each(residuals.by_pose[..., :3] * t[:, None, None, None])
    yield "warming", None, "each", turns, 1
    if 4 <= cameras <= MOST_CAMERAS:
        groups = [g for size in range(2, cameras // 2 + 1) for g in combinations(range(cameras), size)]
        groups = [g for g in groups if 2 * len(g) < cameras or 0 in g]
        for group in groups:
            yield (
                "mixed-calibrations",
                None,
                ", ".join(rig.names[k] for k in group),
                _group(residuals, group),
                len(groups),
            )


def _each(design: Array) -> Array:
    """Return a design (n, c, 2, c p) that gives each camera its own parameters, from a design (n, c, 2, p)."""
    n, c, two, p = design.shape
    wide = np.zeros((n, c, two, c, p))
    for k in range(c):
        wide[:, k, :, k] = design[:, k]
    return wide.reshape(n, c, two, c * p)


def _from_middle(residuals: Residuals, rig: Rig) -> Array:
    """Return image coordinates (n, c, 2) from the principal point in half widths, 0 where unseen."""
    middle = np.array([principal_point_px(camera.lens) for camera in rig.cameras])
    half = np.array([0.5 * camera.width for camera in rig.cameras])
    away = (residuals.xy - middle) / half[:, None]
    return np.where((residuals.weight > 0)[..., None], away, 0.0)


def _fields(residuals: Residuals, rig: Rig) -> Array:
    """Return displacements by radial (r^3, r^5) and decentring distortion and affinity (n, c, 2, 6)."""
    away = _from_middle(residuals, rig)
    x, y = away[..., 0], away[..., 1]
    r2 = x**2 + y**2
    zero = np.zeros_like(x)
    along_x = np.stack([x * r2, x * r2**2, r2 + 2 * x**2, 2 * x * y, x, y], axis=-1)
    along_y = np.stack([y * r2, y * r2**2, 2 * x * y, r2 + 2 * y**2, -y, zero + x], axis=-1)
    return np.stack([along_x, along_y], axis=2)


def _zoom(residuals: Residuals, rig: Rig) -> Array:
    """Return displacements by one factor on the principal distance (n, c, 2, 1) [px]."""
    half = np.array([0.5 * camera.width for camera in rig.cameras])
    return np.asarray(_from_middle(residuals, rig) * half[:, None])[..., None]


def _rows(residuals: Residuals, rig: Rig) -> Array:
    """Return displacements (n, c, 2) [px] by a readout that takes one second from the first to the last row."""
    heights = np.array([camera.height for camera in rig.cameras])
    return np.asarray(residuals.flow * (residuals.xy[..., 1] / heights - 0.5)[..., None])


def _group(residuals: Residuals, group: tuple[int, ...]) -> Array:
    """Return displacements in a group of cameras by a rotation and a shift of the world for these cameras."""
    xyz = residuals.observations.xyz
    x, y, z = (xyz - xyz.mean(axis=0)).T
    zero = np.zeros_like(x)
    turn = np.stack([np.stack([zero, z, -y], 1), np.stack([-z, zero, x], 1), np.stack([y, -x, zero], 1)], 1)
    motion = np.concatenate([turn, np.broadcast_to(np.eye(3), (len(xyz), 3, 3))], axis=2)
    design = np.einsum("ncij,njp->ncip", residuals.by_point, motion)
    only = np.zeros(residuals.weight.shape[1])
    only[list(group)] = 1.0
    return np.asarray(design * only[None, :, None, None])


def _diagnosis(
    code: str, camera: int | None, kind: str, found: Fit, residuals: Residuals, rig: Rig, period_s: float,
    explained: float,
) -> Diagnosis | None:  # fmt: skip
    """Return a model's diagnosis in words; None where its effect is below the limits."""
    name = None if camera is None else rig.names[camera]
    figures = {"unit_weight": residuals.unit_weight, "moved_px": found.moved_px}
    if code in ("sync-lost", "rolling-shutter"):
        value = float(found.values[np.argmax(np.abs(found.values))])
        figures |= {"delay_s": value, "sigma_s": float(np.sqrt(found.covariance.diagonal().max()))}
        if abs(value) < LATE_S:
            return None
        if code == "sync-lost":
            code = _timed(kind, value, period_s, camera is not None)
        told = _time_words(code, kind, value, period_s, name)
    else:
        if found.moved_px < MOVED_PX:
            return None
        told = _place_words(code, kind, found, name, residuals, rig)
    first = (
        f"rays miss each other by {residuals.unit_weight:.1f} times the stated noise ({UNIT_WEIGHT:g} allowed); this "
        f"explains {100 * explained:.0f} % of it (p = {found.p_value:.1g})"
    )
    return Diagnosis(code, found.p_value, (first, told), explained, found.score, name, figures)


def _timed(kind: str, value: float, period_s: float, one: bool) -> str:
    whole = round(value / period_s)
    if one and whole and abs(value / period_s - whole) < WHOLE and kind != "slope":
        return "frames-one-off" if kind == "still" else "dropped-unnoticed"
    return "sync-lost"


def _time_words(code: str, kind: str, value: float, period_s: float, name: str | None) -> str:
    if code == "rolling-shutter":
        return f"from the first to the last row {1e3 * value:.2f} ms pass ({1e6 * LATE_S:.0f} us allowed)"
    if kind == "each":
        return f"cameras expose at different instants, up to {1e3 * abs(value):.2f} ms off the mean"
    when = {"still": "all the time", "slope": "at the end, growing from 0"}.get(kind, f"from {kind[5:]} s on")
    later = "later" if value > 0 else "earlier"
    return (
        f"camera '{name}' shows {1e3 * abs(value):.2f} ms {later} than the others ({abs(value) / period_s:.2f} frame "
        f"periods), {when}"
    )


def _place_words(code: str, kind: str, found: Fit, name: str | None, residuals: Residuals, rig: Rig) -> str:
    images = f"images move by {found.moved_px:.2f} px rms ({MOVED_PX:g} allowed)"
    if code == "mixed-calibrations":
        shift = np.linalg.norm(found.values[3:])
        turn = np.degrees(np.linalg.norm(found.values[:3]))
        return f"cameras {kind} stand {1e3 * shift:.1f} mm and {turn:.2f} deg off the others as a group: {images}"
    if code == "camera-moved":
        turn = np.degrees(np.linalg.norm(found.values[:3]))
        when = {"still": "all the time", "creeps": "growing over the take"}.get(kind, f"from {kind[5:]} s on")
        return f"camera '{name}' is turned by {turn:.2f} deg, {when}: {images}"
    if code == "wrong-lens":
        where = f"camera '{name}'" if name else "all cameras"
        return f"residuals of {where} follow the distance from the image's middle: {images}"
    if code == "other-resolution":
        factor = 1 + float(found.values[np.argmax(np.abs(found.values))])
        return f"principal distances fit {factor:.3f} times those of the rig file: {images}"
    return f"all cameras' images drift over the take: {images}"
