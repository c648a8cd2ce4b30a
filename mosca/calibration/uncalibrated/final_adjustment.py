"""The last adjustment of a wand calibration: all image points, all lens parameters that the data determine."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mosca.calibration.bundle.solver import FOCAL, BundleSettings
from mosca.calibration.uncalibrated.hidden_by_wand import without_hidden
from mosca.calibration.uncalibrated.image_points import PointViews
from mosca.calibration.uncalibrated.partial_adjustment import CLEAR_SIGMAS, Network, cleaned, imaged, network
from mosca.camera.projection import fit_lens, lens_directions
from mosca.data.arrays import Array
from mosca.data.distributions import chi2
from mosca.data.rig import Camera, Lens, MoscaLens, OpenCVLens
from mosca.errors import CalibrationError

Free = tuple[str, ...]

BASIC: dict[str, Free] = {
    "mosca": ("c_mm", "xp_px", "yp_px", "K1_per_mm2", "K2_per_mm4"),
    "opencv": (FOCAL, "cx_px", "cy_px", "k1", "k2"),
}
"""Lens parameters that are always estimated, and held by the solver where the data are weak."""
PIXEL_SHAPE = ("fx_px", "fy_px")
"""Parameters that replace the common focal length, since pixels need not be square."""
EXTRA: dict[str, tuple[Free, ...]] = {
    "mosca": (("P1_per_mm", "P2_per_mm"), ("my_mm_per_px", "a"), ("K3_per_mm6",)),
    "opencv": (("p1", "p2"), PIXEL_SHAPE, ("k3",)),
}
"""Lens parameters that join, group by group for all cameras, where they lower the sum of squares significantly."""
FOCAL_NAME = {"mosca": "c_mm", "opencv": FOCAL}
SIGNIFICANT = 1e-3
"""Significance level of the likelihood-ratio test for further lens parameters."""
BLUNDER_SIGNIFICANCE = 0.05
"""Chance that a good image point is rejected, in the whole session."""
# residuals beyond so many robust standard deviations are blunders at first sight
GROSS_SIGMAS = 6.0
ROUNDS = 3


def finished(start: Network, tracks: PointViews, only: Free | None = None) -> Network:
    """Return the network of all image points with lenses of the models of ``tracks.lenses``.

    ``only``: the lens parameters to estimate; None: those that the data determine.
    """
    cameras = {k: _in_model(camera, tracks.lenses[k]) for k, camera in start.cameras.items()}
    if only is not None:
        cameras = {k: _without_others(camera, only) for k, camera in cameras.items()}
    model = {k: camera.lens.model for k, camera in cameras.items()}
    usable = cleaned(imaged(tracks, cameras), cameras, CLEAR_SIGMAS * start.spread)
    usable = usable.of_cameras(cameras)
    free = {k: only or BASIC[model[k]] for k in cameras}
    plain = BundleSettings(tolerance=0.1, most_steps=50, precision=False)
    one = network(usable, cameras, free, plain)
    for _ in range(ROUNDS):
        fewer = _without_gross(one)
        if len(fewer) == len(one.tracks):
            break
        usable = fewer
        one = network(usable, one.cameras, free, plain, points=one.points)
    for step in range(max(len(EXTRA[m]) for m in model.values()) if only is None else 0):
        richer = {k: _joined(free[k], EXTRA[model[k]][step : step + 1]) for k in free}
        trial = network(usable, one.cameras, richer, plain, points=one.points)
        joined = sum(len(richer[k]) - len(free[k]) for k in free)
        gain = (one.adjustment.cost - trial.adjustment.cost) / trial.adjustment.sigma0**2
        if trial.adjustment.converged and not _held_more(trial, one) and chi2.sf(gain, joined) < SIGNIFICANT:
            one, free = trial, richer
    judged = replace(plain, precision=True)
    one = network(usable, one.cameras, free, judged, points=one.points)
    one = without_hidden(one, lambda now, tracks: network(tracks, now.cameras, free, judged, points=now.points))
    last = BundleSettings(blunder_significance=BLUNDER_SIGNIFICANCE)
    return network(one.tracks, one.cameras, free, last, points=one.points)


def lens_parameters(model: str) -> Free:
    """Return all parameters of a lens model that a wand can determine."""
    return _joined(BASIC[model], EXTRA[model])


def _joined(free: Free, groups: tuple[Free, ...]) -> Free:
    """Return the free lens parameters with those of a group, if any."""
    for group in groups:
        free = tuple(name for name in free if name != FOCAL or group != PIXEL_SHAPE) + group
    return free


def _without_others(camera: Camera, only: Free) -> Camera:
    """Return the camera without those distortion parameters of its first lens that are not to be estimated."""
    radial = ("K1_per_mm2", "K2_per_mm4", "k1", "k2")
    none: dict[str, Any] = {name: 0.0 for name in radial if hasattr(camera.lens, name) and name not in only}
    return replace(camera, lens=replace(camera.lens, **none))


def _held_more(trial: Network, one: Network) -> bool:
    """Return whether a richer model made the solver hold more of the parameters that both have."""
    common = set(one.adjustment.parameters) - set(one.adjustment.held)
    return bool(common & set(trial.adjustment.held))


def _without_gross(one: Network) -> PointViews:
    """Return the image points without gross blunders."""
    far = np.linalg.norm(one.residuals_px, axis=1) / one.tracks.sigma_px
    good = far <= GROSS_SIGMAS * max(one.spread, 1e-9)
    return one.tracks.only(good).of_cameras(one.cameras)


def _in_model(camera: Camera, wanted: Lens) -> Camera:
    """Return the camera with the lens model and pixel aspect of ``wanted``."""
    if isinstance(wanted, OpenCVLens):
        return camera
    if not isinstance(wanted, MoscaLens) or not isinstance(camera.lens, OpenCVLens):
        raise CalibrationError(f"camera '{camera.name}': lens model '{wanted.model}' cannot be found here")
    across, down = np.meshgrid(np.linspace(0, camera.width - 1, 15), np.linspace(0, camera.height - 1, 11))
    pixels = np.column_stack([across.ravel(), down.ravel()])
    rays = lens_directions(camera.lens, pixels)
    plain = MoscaLens(
        camera.lens.fx_px * wanted.mx_mm_per_px,
        camera.lens.cx_px,
        camera.lens.cy_px,
        wanted.mx_mm_per_px,
        wanted.my_mm_per_px,
    )
    fitted = fit_lens("mosca", pixels, rays, plain).lens
    assert isinstance(fitted, MoscaLens)  # the model asked for
    radial = replace(plain, c_mm=fitted.c_mm, K1_per_mm2=fitted.K1_per_mm2, K2_per_mm4=fitted.K2_per_mm4)
    return replace(camera, lens=radial)


def focal_sigmas(one: Network) -> Mapping[int, float]:
    """Return the standard deviation of each camera's focal length over the focal length."""
    sigma = one.adjustment.standard_deviations
    out = {}
    for k, camera in one.cameras.items():
        names = (FOCAL_NAME[camera.lens.model], "fx_px")
        name = next(name for name in names if f"{camera.name}.{name}" in sigma)
        value = camera.lens.c_mm if isinstance(camera.lens, MoscaLens) else camera.lens.fx_px
        out[k] = sigma[f"{camera.name}.{name}"] / value
    return out


def depths(one: Network) -> Array:
    """Return the depth (n,) of each used image point in front of its camera."""
    out = np.full(len(one.tracks), np.nan)
    for k, camera in one.cameras.items():
        mine = (one.tracks.camera == k) & one.adjustment.used
        pose = camera.world_from_camera
        out[mine] = (one.points[one.tracks.point[mine]] - pose.translation) @ pose.rotation[:, 2]
    result: Array = out[np.isfinite(out)]
    return result
