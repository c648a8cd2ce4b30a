"""Adjustment of one camera from known points: interior and exterior orientation, their precision, and blunders.

Starting values come from ``resection``. The lens parameters to estimate are selected from the data
(``parameter_selection``), and blunders are found at the same time (``outliers``), since the two depend on each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from mosca.calibration.initial.resection import Resection, aim, resect, resect_fisheye
from mosca.calibration.single_camera.least_squares import CameraFit, fit_camera, residuals_of
from mosca.calibration.single_camera.outliers import LEAST_REDUNDANCY, robust_points, snoop
from mosca.calibration.single_camera.parameter_selection import choose_parameters, groups_of, nested_parameters
from mosca.data.arrays import Array, read_only
from mosca.data.rig import LENS_MODELS, Camera, FisheyeLens, Lens, MoscaLens, OpenCVLens, Pose, principal_distances_px
from mosca.errors import CalibrationError, InputError

ROUNDS = 4


@dataclass(frozen=True)
class AdjustmentSettings:
    """Settings of a single camera's adjustment.

    ``parameters``: lens parameters to estimate; None: those that the data determine, among them OpenCV's thin prism
    unless ``prism`` is False. ``significance``: level of the F-test by which a group joins. ``blunder_significance``:
    chance that a point is rejected in an adjustment without blunders. ``max_sigma0_px`` and ``max_rejected``: beyond
    these the result is refused. ``pixel_pitch_mm``: mx of a Mosca lens, which is held (the sensor's data sheet; it
    only sets the unit of c).
    """

    parameters: tuple[str, ...] | None = None
    prism: bool = True
    significance: float = 0.001
    blunder_significance: float = 0.01
    max_sigma0_px: float = 2.0
    max_rejected: float = 0.3
    pixel_pitch_mm: float = 0.01


@dataclass(frozen=True, eq=False)
class CameraAdjustment:
    """An adjusted camera and its precision.

    ``residuals_px`` (n, 2) observed minus projected of all points, also rejected ones; ``used`` (n,) bool;
    ``parameters`` names of the p unknowns (rotation about the camera's own axes, position, lens) and their
    ``covariance`` (p, p) in these units; ``sigma0_px`` a-posteriori standard deviation of an image
    coordinate; ``sigma_x_px``, ``sigma_y_px`` the same of each coordinate and ``sigma_x_m``, ``sigma_y_m``
    carried to the target (the paper's figure of a calibration, Table 2); ``chosen`` the groups that joined and
    the F-test's p-value of each.
    """

    camera: Camera
    residuals_px: Array
    used: Array
    parameters: tuple[str, ...]
    covariance: Array
    sigma0_px: float
    sigma_x_px: float
    sigma_y_px: float
    sigma_x_m: float
    sigma_y_m: float
    chosen: tuple[tuple[str, float], ...]

    def __post_init__(self) -> None:
        n, p = len(np.asarray(self.used)), len(self.parameters)
        object.__setattr__(self, "residuals_px", read_only(self.residuals_px, (n, 2), "residuals_px"))
        object.__setattr__(self, "used", read_only(self.used, (n,), "used", np.bool_))
        object.__setattr__(self, "covariance", read_only(self.covariance, (p, p), "covariance"))

    @property
    def rejected(self) -> Array:
        """Indices of the points rejected as blunders."""
        return np.flatnonzero(~self.used)

    @property
    def standard_deviations(self) -> dict[str, float]:
        """Standard deviation of each unknown, by name."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def adjust_camera(
    name: str,
    size: tuple[int, int],
    model: str,
    xy_px: Array,
    xyz: Array,
    rng: np.random.Generator,
    settings: AdjustmentSettings | None = None,
) -> CameraAdjustment:
    """Adjust a camera of ``size`` (width, height) to pixels (n, 2) of known points (n, 3) [m, world frame].

    ``model``: mosca, opencv or fisheye. ``rng`` draws the samples that find the starting values.
    CalibrationError where the points do not determine the camera, or no camera fits them; InputError for an
    unknown model or parameter.
    """
    settings = settings or AdjustmentSettings()
    where = f"camera '{name}'"
    check_lens(where, model, settings.parameters)
    xy, world = np.asarray(xy_px, dtype=float).reshape(-1, 2), np.asarray(xyz, dtype=float).reshape(-1, 3)
    if model == "fisheye":
        first = resect_fisheye(where, size, xy, world, rng)
    else:
        first = resect(where, xy, world, rng)
    start = _start(name, size, model, first, settings)
    # the prism's terms dominate the corners: with them a blunder in one could reject the good point opposite
    nested = nested_parameters(model, int(first.inliers.sum()), groups_of(model, prism=False))
    used = robust_points(start, nested, xy, world, first.inliers)
    # the selection of parameters and the rejection of points depend on each other; it ends after four rounds
    for _ in range(ROUNDS):
        fit, chosen = _chosen_fit(where, start, xy, world, used, settings)
        fit, kept = snoop(fit, xy, world, used, settings.blunder_significance)
        if (kept == used).all():
            break
        used = kept
    return _checked(where, fit, xy, world, used, chosen, settings)


def check_lens(where: str, model: str, parameters: Sequence[str] | None) -> None:
    """Raise InputError for an unknown lens model, or a parameter that it does not have or that is always held.

    ``where`` begins the message (for instance "camera 'left'").
    """
    if model not in LENS_MODELS:
        raise InputError(f"{where}: lens model '{model}' is unknown; there are {', '.join(LENS_MODELS)}")
    allowed = [p for p in (f.name for f in fields(LENS_MODELS[model])) if p != "mx_mm_per_px"]
    for parameter in parameters or ():
        if parameter not in allowed:
            raise InputError(
                f"{where}: lens parameter '{parameter}' cannot be estimated; allowed: {', '.join(allowed)}"
            )


def _start(name: str, size: tuple[int, int], model: str, first: Resection, settings: AdjustmentSettings) -> Camera:
    """Return the resected camera with its principal point moved to the middle of the image."""
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    fx, fy = first.lens.fx_px, first.lens.fy_px
    pitch = settings.pixel_pitch_mm
    lens: Lens
    if model == "mosca":
        lens = MoscaLens(fx * pitch, *centre, pitch, pitch * fx / fy)
    elif model == "opencv":
        lens = OpenCVLens(fx, fy, *centre)
    elif model == "fisheye":
        lens = FisheyeLens(fx, fy, *centre)
    else:
        raise ValueError(f"lens model '{model}' given; mosca, opencv or fisheye is wanted")
    pose: Pose = aim(first, centre)
    return Camera(name, size[0], size[1], lens, pose)


def _chosen_fit(
    where: str, start: Camera, xy: Array, world: Array, used: Array, settings: AdjustmentSettings
) -> tuple[CameraFit, tuple[tuple[str, float], ...]]:
    """Return the fit with the parameters that the used points determine, and the groups with their p-values."""
    points, pixels = world[used], xy[used]
    if settings.parameters is not None:
        fit = fit_camera(start, tuple(settings.parameters), pixels, points)
        if fit.cofactors is None or 2 * len(points) - len(fit.parameters) < LEAST_REDUNDANCY:
            raise CalibrationError(
                f"{where}: {len(points)} points do not determine {', '.join(settings.parameters)} and the pose; "
                "hold some parameters or measure more points, farther apart"
            )
        return fit, ()
    fit, chosen = choose_parameters(
        start, pixels, points, settings.significance, groups_of(start.lens.model, settings.prism)
    )
    if fit.cofactors is None:
        raise CalibrationError(
            f"{where}: {len(points)} points do not determine the scale and the pose; "
            "measure more points, farther apart in depth"
        )
    return fit, chosen


def _checked(
    where: str,
    fit: CameraFit,
    xy: Array,
    world: Array,
    used: Array,
    chosen: tuple[tuple[str, float], ...],
    settings: AdjustmentSettings,
) -> CameraAdjustment:
    redundancy = 2 * int(used.sum()) - len(fit.parameters)
    sigma0 = float(np.sqrt(fit.cost / redundancy))
    if sigma0 > settings.max_sigma0_px:
        raise CalibrationError(
            f"lens-model: {where}: residuals of {sigma0:.2f} px after the adjustment, "
            f"{settings.max_sigma0_px:g} allowed; check the target's dimensions, the pairs and the lens model"
        )
    if np.mean(~used) > settings.max_rejected:
        raise CalibrationError(
            f"blunders: {where}: {int((~used).sum())} of {len(used)} points do not fit the camera, at most "
            f"{settings.max_rejected:.0%} may be rejected; check the pairs and the lens model"
        )
    everyone = residuals_of(fit.camera, xy, world)
    # size of one pixel on the target at each point's own distance (a fisheye's scale is an angle)
    seen = fit.camera.world_from_camera.inverse().transform(world[used])
    depth = np.linalg.norm(seen, axis=1) if isinstance(fit.camera.lens, FisheyeLens) else seen[:, 2]
    residuals = everyone[used]
    share = redundancy / (2 * used.sum())
    sigma_px = np.sqrt(np.mean(residuals**2, axis=0) / share)
    fx, fy = principal_distances_px(fit.camera.lens)
    sigma_m = np.sqrt(np.mean((residuals * depth[:, None] / (fx, fy)) ** 2, axis=0) / share)
    assert fit.cofactors is not None
    return CameraAdjustment(
        fit.camera,
        everyone,
        used,
        fit.parameters,
        sigma0**2 * fit.cofactors,
        sigma0,
        float(sigma_px[0]),
        float(sigma_px[1]),
        float(sigma_m[0]),
        float(sigma_m[1]),
        chosen,
    )
