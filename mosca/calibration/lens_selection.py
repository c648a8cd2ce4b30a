"""Selection of the lens model: the one that best predicts views that took no part in its estimation.

Cross-validation (Stone 1974): the views, in the order of time, are divided into FOLDS parts. Cameras and lenses are
adjusted to all parts but one. In that part the target's poses, or a wand's points, are estimated from all cameras but
one and predict the image points of that camera; this is done for each camera. Parts are whole stretches of time,
since neighbouring views are nearly the same. The first model stays unless another one has significantly smaller
errors in a paired t-test over the views.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.calibration.bundle.solver import (
    BundleSettings,
    CameraUnknowns,
    Distances,
    ObjectPoints,
    Observations,
    Placements,
    Problem,
    solve,
)
from mosca.calibration.quality.findings import note
from mosca.calibration.rigid_target import FREE, LEAST_SIGMA_PX
from mosca.calibration.single_camera.interior_orientation import LensChoice, plain_lens
from mosca.calibration.uncalibrated.final_adjustment import lens_parameters
from mosca.camera.projection import fit_lens, image_grid, lens_directions, project
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration
from mosca.data.distributions import t as t_distribution
from mosca.data.rig import LENS_MODELS, Camera, Lens, principal_distances_px
from mosca.errors import CalibrationError

FOLDS = 3
"""Number of parts; more parts take more time. Each model is adjusted to two thirds of the views."""
FEWEST_VIEWS = 4
SIGNIFICANT = 0.01
"""Level at which another model must be better than the first one."""
GROSS_SIGMAS = 6.0
"""Larger errors count as this many standard deviations: they are blunders in every model."""
QUICK = BundleSettings(loss="cauchy", loss_scale=3.0, tolerance=0.1, most_steps=20, precision=False)
"""Settings for each fold and model: robust beyond 3 standard deviations, converged to a tenth of one."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of a lens model in views that it was not adjusted to.

    ``rms_px``: of an image coordinate; ``squares`` (v,): sum of squared errors of each view [sigma^2].
    """

    model: str
    rms_px: float
    squares: Array


def calibrated_with_best(
    calibrated: Callable[[str], Calibration], choice: LensChoice, rods: Distances | None
) -> Calibration:
    """Return the calibration whose lens model predicts held-out views best, with a note of the figures.

    ``calibrated``: calibrates with a lens model, by name; ``choice.model`` is the first. ``rods``: known distances
    between the points of a wand's calibration, None for a rigid target. Where no model succeeds, the error of the
    first model is raised.
    """
    models = [choice.model, *(m for m in LENS_MODELS if m != choice.model and (rods is None or m != "fisheye"))]
    first = _first_possible(calibrated, models)
    found = held_out(first, models, choice, rods)
    if not found:
        return first
    best = preferred(found)
    one = first
    if best.model != first.rig.cameras[0].lens.model:
        try:
            one = calibrated(best.model)
        except CalibrationError:
            best = next(trial for trial in found if trial.model == first.rig.cameras[0].lens.model)
    others = ", ".join(f"{trial.model} {trial.rms_px:.4f}" for trial in found if trial is not best)
    text = (
        f"lens model {best.model}: image points of held-out views are predicted to {best.rms_px:.4f} px rms "
        f"({others}; {FOLDS} parts of {len(best.squares)} views); --lens orders another"
    )
    return replace(one, findings=(*one.findings, note("lens-choice", text)))


def _first_possible(calibrated: Callable[[str], Calibration], models: Sequence[str]) -> Calibration:
    failure: CalibrationError | None = None
    for model in models:
        try:
            return calibrated(model)
        except CalibrationError as error:
            if error.unseen:
                raise
            failure = failure or error
    assert failure is not None  # there are models
    raise failure


def preferred(found: Sequence[HeldOut]) -> HeldOut:
    """Return the first of the trials, or the best where it is significantly better."""
    best = min(found, key=lambda trial: float(trial.squares.sum()))
    gain = found[0].squares - best.squares
    n, spread = len(gain), float(gain.std(ddof=1))
    if best is found[0] or spread == 0:
        return best
    return best if t_distribution.sf(gain.mean() / spread * np.sqrt(n), n - 1) < SIGNIFICANT else found[0]


def held_out(
    calibration: Calibration, models: Sequence[str], choice: LensChoice, rods: Distances | None
) -> tuple[HeldOut, ...]:
    """Return each model's errors in held-out views, from a calibration with any model; empty with too few views.

    ``rods``: known distances between the points of a wand's calibration, None for a rigid target.
    """
    see = calibration.sightings
    view = see.frame if rods is not None else calibration.placement
    # the target's pose in the reference view defines the world: this view is never left out
    views = np.unique(view[view >= 0])
    if len(views) < FEWEST_VIEWS:
        return ()
    part = np.full(len(see), -1)
    part[view >= 0] = (np.searchsorted(views, view[view >= 0]) * FOLDS) // len(views)
    placed = np.isfinite(calibration.marks_m[see.mark]).all(axis=1)
    sigma = np.maximum(see.sigma_px, LEAST_SIGMA_PX) * max(calibration.sigma0, 1.0)
    out = []
    for model in models:
        cameras = tuple(_with_model(camera, choice.of(camera.name), model) for camera in calibration.rig.cameras)
        free = FREE[model] if rods is None else lens_parameters(model)
        unknowns = tuple(CameraUnknowns(camera, free=free) for camera in cameras)
        missed = np.full(len(see), np.nan)
        try:
            for fold in range(FOLDS):
                fitted = solve(_problem(calibration, unknowns, placed & (part != fold), sigma, rods), QUICK)
                test = placed & (part == fold)
                missed[test] = _missed_px(calibration, fitted.cameras, test, sigma, rods)[test]
        except CalibrationError:
            # a camera saw the target in one part only, and is undetermined without that part
            return ()
        known = np.isfinite(missed)
        missed = np.minimum(missed[known], GROSS_SIGMAS * sigma[known])
        squares = np.bincount(np.searchsorted(views, view[known]), (missed / sigma[known]) ** 2, len(views))
        out.append(HeldOut(model, float(np.sqrt(np.mean(missed**2) / 2)), squares))
    return tuple(out)


def _missed_px(
    calibration: Calibration, cameras: tuple[Camera, ...], test: Array, sigma: Array, rods: Distances | None
) -> Array:
    """Return the distances (n,) [px] of the image points ``test`` (n,) bool from the other cameras' predictions.

    NaN for all other image points, and where other cameras do not see the target; inf where a camera does not image
    the prediction.
    """
    see, out = calibration.sightings, np.full(len(calibration.sightings), np.nan)
    held = tuple(CameraUnknowns(camera, held=True) for camera in cameras)
    for camera in cameras:
        mine = test & (see.camera == see.cameras.index(camera.name))
        others = test & ~mine
        # three marks give a pose; two rays a point
        group, fewest = (calibration.placement, 3) if rods is None else (see.mark, 2)
        count = np.bincount(group[others], minlength=int(group.max()) + 1)
        others &= (count >= fewest)[group]
        rows = np.flatnonzero(mine & (count >= fewest)[group])
        if len(rows) == 0:
            continue
        found = solve(_problem(calibration, held, others, sigma, rods), QUICK)
        if rods is None:
            pose = calibration.placement[rows]
            at = np.einsum("nij,nj->ni", found.placements.rotation[pose], calibration.marks_m[see.mark[rows]])
            at = at + found.placements.translation[pose]
        else:
            at = found.points[np.searchsorted(np.unique(see.mark[others]), see.mark[rows])]
        distance = np.linalg.norm(project(camera, at) - see.xy_px[rows], axis=1)
        out[rows] = np.nan_to_num(distance, nan=np.inf)
    return out


def _problem(
    calibration: Calibration, cameras: tuple[CameraUnknowns, ...], rows: Array, sigma: Array, rods: Distances | None
) -> Problem:
    """Return the problem for the image points ``rows`` (n,) bool of a calibration, with all poses and points free."""
    see = calibration.sightings
    number = [calibration.rig.names.index(name) if name in calibration.rig.names else -1 for name in see.cameras]
    seen = (np.array(number)[see.camera[rows]], see.mark[rows], see.xy_px[rows])
    if rods is None:
        poses = Placements(calibration.target_rotation, calibration.target_translation)
        observations = Observations(*seen, calibration.placement[rows], sigma[rows])
        return Problem(cameras, observations, ObjectPoints.fixed(calibration.marks_m), poses)
    points = np.unique(seen[1])
    new = np.full(len(calibration.marks_m), -1)
    new[points] = np.arange(len(points))
    both = (new[rods.first] >= 0) & (new[rods.second] >= 0)
    lengths = Distances(new[rods.first[both]], new[rods.second[both]], rods.length_m[both], rods.sigma_m[both])
    observations = Observations(seen[0], new[seen[1]], seen[2], sigma_px=sigma[rows])
    held = all(camera.held for camera in cameras)
    return Problem(
        cameras,
        observations,
        ObjectPoints.free(calibration.marks_m[points]),
        distances=lengths,
        datum="given" if held else "points",
    )


def _with_model(camera: Camera, choice: LensChoice, model: str) -> Camera:
    """Return the camera with a lens of the given model, as similar as possible to its own."""
    if camera.lens.model == model:
        return camera
    pixels = image_grid(camera.width, camera.height)
    start: Lens = plain_lens(
        replace(choice, model=model), principal_distances_px(camera.lens)[0], (camera.width, camera.height)
    )
    return replace(camera, lens=fit_lens(model, pixels, lens_directions(camera.lens, pixels), start).lens)
