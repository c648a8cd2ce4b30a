"""The plan: the best layout for each number of cameras, and the predictions for the best."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mosca.accuracy.planning.cut_discs import measured, taken_variance
from mosca.accuracy.planning.field_calibration import common_covariance, parameter_covariance
from mosca.accuracy.planning.layout import CameraOption, Layout, MountingPlace, direction, planned_rig
from mosca.accuracy.planning.objective import Objective, PredictedMarkers
from mosca.accuracy.planning.search import WIDE, PlacementTask, first_layout, search
from mosca.accuracy.planning.views import SCALE, MarkerRoom, Softness, view_table
from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.rig import Rig
from mosca.errors import InputError
from scenarios.spec.plan import PlanFile
from scenarios.studies.plan.room import (
    bounding_box,
    keep_out_of,
    mounts_of,
    normals_of,
    options_of,
    points_in,
    room_of,
    session_of,
    worn_markers_of,
)

SEARCH_POINTS, CURVE_POINTS, REPORT_POINTS = 320, 160, 1000
"""Number of points of the volume at which the search predicts, for the most cameras and for fewer, and of other
points for the reported figures. In a room with a subject and 8 cameras 160 gave 0.116 mm at the others, 320 0.107,
500 0.109.
"""
CURVE_SHARE = 0.35
"""Share of the evaluations for each number of cameras below the largest."""


@dataclass(frozen=True)
class PlanSettings:
    """Settings of the search."""

    evaluations: int = 8000
    curve: bool = True
    """Whether to plan also with fewer cameras."""


@dataclass(frozen=True, eq=False)
class VolumePrediction(PredictedMarkers):
    """Predictions for markers in the volume; standard deviation and covariance include the calibration's part."""

    points: Array
    """(n, 3) [m]"""
    calibration_m: Array
    """(n, k) the calibration's share [m]."""


@dataclass(frozen=True, eq=False)
class Planned:
    """A planned rig, and the predictions for it."""

    layout: Layout
    rig: Rig
    price: float
    predicted: VolumePrediction
    rank: tuple[float, float]
    """What plans are compared by, the less the better: the quantile, then the share that is not seen; as in the
    search without overlapping images, which would make many plans' quantile infinite."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Plans for ascending numbers of cameras; ``best`` is the one with the least predicted quantile."""

    spec: PlanFile
    options: tuple[CameraOption, ...]
    mounts: tuple[MountingPlace, ...]
    planned: Mapping[int, Planned]
    start: Planned
    """Cameras evenly spaced along the mounts, as many as ``best`` has, aimed at the volume's centre."""

    @property
    def best(self) -> Planned:
        """The plan with the least predicted quantile."""
        return min(self.planned.values(), key=lambda one: one.rank)


def make_plan(
    spec: PlanFile, settings: PlanSettings, told: Callable[[int, int], None] = lambda done, most: None
) -> Plan:
    """Return the plan of ``spec``. InputError where no layout keeps the budget, or almost no position is seen.

    ``told``: called with the numbers of evaluations done and wanted.
    """
    most = spec.budget.cameras
    cheapest = min(one.price for one in spec.camera)
    if spec.budget.money is not None and cheapest > 0:
        most = min(most, int(spec.budget.money // cheapest))
    least = max(2, spec.goal.seen_by)
    counts = [*range(least, most)] if settings.curve else []
    wanted = int(settings.evaluations * (CURVE_SHARE * len(counts) + 1))
    mounts = mounts_of(spec)
    calibration_px = _calibration_px(spec, mounts, most)
    tasks = [task_of(spec, points_in(spec, n, spec.seed), calibration_px) for n in (CURVE_POINTS, SEARCH_POINTS)]
    planned: dict[int, Planned] = {}
    starts: dict[int, Planned] = {}
    done = 0
    for count in (*counts, most):
        evaluations = settings.evaluations if count == most else int(CURVE_SHARE * settings.evaluations)
        task = tasks[count == most]
        layout = search(
            task, count, evaluations=evaluations, seed=spec.seed + 1, told=_from(told, done, wanted)
        )  # fmt: skip
        done += evaluations
        starts[count] = _planned(spec, task, start := first_layout(task, count))
        found = [_planned(spec, task, layout)] if task.allowed(layout) else []
        # the search uses few points, and the calibration as a fixed noise: its gain may be none at other points
        found += [starts[count]] if task.allowed(start) else []
        if found:
            planned[count] = min(found, key=lambda one: one.rank)
    if not planned:
        raise InputError(
            f"budget.cameras = {most}: no layout keeps goal.spacing_m, the room and the money; allow more room, more "
            "money or fewer cameras"
        )
    best = min(planned, key=lambda count: planned[count].rank)
    return Plan(spec, tasks[0].options, mounts, planned, starts[best])


def _from(told: Callable[[int, int], None], before: int, wanted: int) -> Callable[[int, int], None]:
    """Return the progress function of a search that began after ``before`` of all ``wanted`` evaluations."""
    return lambda done, _: told(min(before + done, wanted), wanted)


def task_of(spec: PlanFile, points: Array, calibration_px: float) -> PlacementTask:
    """Return the search over ``points`` (n, 3); ``calibration_px``: error of an image point by the calibration."""
    room = room_of(spec, points)
    objective = Objective(room, spec.goal.quantile, spec.goal.seen_by, float(bounding_box(spec)[1].max()), WIDE)
    return PlacementTask(
        objective, mounts_of(spec), options_of(spec, calibration_px), spec.budget.money, spec.goal.spacing_m,
        keep_out_of(spec),
    )  # fmt: skip


def predicted_of(
    spec: PlanFile, rig: Rig, rows: Array, room: MarkerRoom, *, overlaps: bool = True
) -> VolumePrediction:
    """Return the predictions for the markers of ``room`` with ``rig`` and its rows (c, COLUMNS).

    ``overlaps``: whether images that overlap those of other markers on the subject count as missing.

    The covariance is given for all markers that the pipeline measures. Sigma is infinite where fewer cameras than
    wanted see at least half of a marker.
    """
    points, places = room.points, rows[:, :3]
    seen, variance = view_table(
        rows, points, np.empty((0, 3)), room.obstacles, room.center, room.diameter_m, room.tables, Softness().row
    )
    in_view = seen[:, :, 0] > 0.5
    known = parameter_covariance(rig, session_of(spec, places, spec.seed))
    worn, normals = worn_markers_of(spec), room.normals if len(room.normals) else np.zeros((1, 3))
    radius_px = rows[:, SCALE, None] * room.diameter_m / (2 * np.linalg.norm(points - places[:, None], axis=2))
    n, kinds = len(points), len(normals)
    covariance = np.full((n, kinds, 3, 3), np.nan)
    common, sigma = np.full((2, n, kinds), np.inf)
    count = np.zeros((n, kinds), int)
    for k, normal in enumerate(normals):
        seen, hidden, shift, edge = in_view, *np.zeros((2, *in_view.shape)), np.zeros((*in_view.shape, 3))
        if worn is not None and normal.any():
            hidden, shift, edge = worn.images(points, normal, places)
            if overlaps:
                seen = in_view & ~worn.overlapping(points, normal, normals_of(spec), places)
        count[:, k] = (seen & (hidden <= 0.5)).sum(axis=0)
        good = measured(seen, hidden)
        images = (seen & (hidden < 1.0))[:, good]
        true = np.where(images, variance[:, good], 1.0)
        weights = np.where(images, 1.0 / taken_variance(hidden[:, good], radius_px[:, good], true), 0.0)
        displaced = 0.5 * room.diameter_m * shift[:, good, None] * edge[:, good]
        of_rig = common_covariance(rig, known, points[good], weights)
        covariance[good, k] = _of_images(rig, points[good], weights, true, displaced) + of_rig
        enough = good & (count[:, k] >= max(2, spec.goal.seen_by))
        sigma[enough, k] = np.sqrt(np.trace(covariance[enough, k], axis1=1, axis2=2))
        common[good, k] = np.sqrt(np.trace(of_rig, axis1=1, axis2=2))
        common[~enough, k] = np.inf
    return VolumePrediction(sigma, covariance, count, points, common)


def result_document(plan: Plan) -> dict[str, Any]:
    """Return the result file's content: the curve, the cameras and the figures, lengths in metres."""
    spec, best = plan.spec, plan.best
    share = spec.goal.quantile
    center, size = bounding_box(spec)
    return {
        "title": spec.title,
        "quantile": share,
        "seen_by": spec.goal.seen_by,
        "predicted": figures_of(best.predicted, share),
        "evenly_spaced": figures_of(plan.start.predicted, share),
        "price": best.price,
        "volume": {
            "center_m": center.tolist(),
            "size_m": size.tolist(),
            "corners_m": None if spec.volume.corners_m is None else [list(one) for one in spec.volume.corners_m],
        },
        "cameras": camera_rows(plan, best),
        "curve": [
            {"cameras": count, "price": one.price, **figures_of(one.predicted, share)}
            for count, one in plan.planned.items()
        ],
        "conditions": spec.model_dump(mode="json"),
    }


def figures_of(predicted: VolumePrediction, share: float) -> dict[str, float | None]:
    """Return the figures of a prediction; None for infinite values."""
    finite = predicted.sigma_m[np.isfinite(predicted.sigma_m)]
    quantile = predicted.quantile_m(share)
    common = predicted.calibration_m[np.isfinite(predicted.calibration_m)]
    return {
        "sigma_quantile_m": quantile if np.isfinite(quantile) else None,
        "sigma_rms_m": float(np.sqrt(np.mean(finite**2))) if len(finite) else None,
        "calibration_rms_m": float(np.sqrt(np.mean(common**2))) if len(common) else None,
        "unseen_share": predicted.unseen(2),
    }


def camera_rows(plan: Plan, one: Planned) -> list[dict[str, Any]]:
    """Return a row for each camera of a planned rig."""
    places, ahead = one.layout.places(plan.mounts), direction(one.layout.angles)
    return [
        {
            "name": camera.name,
            "model": (option := plan.options[one.layout.option[k]]).model,
            "focal_mm": option.focal_mm,
            "price": option.price,
            "position_m": places[k].tolist(),
            "direction": ahead[k].tolist(),
            "pan_deg": float(np.degrees(one.layout.angles[k, 0]) % 360),
            "tilt_deg": float(np.degrees(one.layout.angles[k, 1])),
            "size_px": [option.width, option.height],
            "pitch_mm": option.pitch_mm,
        }
        for k, camera in enumerate(one.rig.cameras)
    ]


def _planned(spec: PlanFile, task: PlacementTask, layout: Layout) -> Planned:
    options = options_of(spec)
    rig = planned_rig(layout, task.mounts, options)
    rows = layout.rows(task.mounts, replace(task, options=options).option_rows)
    room = room_of(spec, points_in(spec, REPORT_POINTS, spec.seed + 1000))
    predicted = predicted_of(spec, rig, rows, room)
    apart = predicted if spec.subject is None else predicted_of(spec, rig, rows, room, overlaps=False)
    rank = apart.quantile_m(spec.goal.quantile), apart.unseen(2)
    return Planned(layout, rig, layout.price(options), predicted, rank)


def _calibration_px(spec: PlanFile, mounts: tuple[MountingPlace, ...], count: int) -> float:
    """Return the error of an image point by the calibration, rms on each axis [px], for evenly spaced cameras.

    The search takes it as noise of the image points; its dependence on the layout is predicted only for the result.
    """
    task = task_of(spec, points_in(spec, SEARCH_POINTS, spec.seed), 0.0)
    layout = first_layout(task, count)
    rows = layout.rows(mounts, task.option_rows)
    room = room_of(spec, points_in(spec, REPORT_POINTS, spec.seed + 1000))
    found = predicted_of(spec, planned_rig(layout, mounts, task.options), rows, room, overlaps=False)
    seen = np.isfinite(found.sigma_m) & (found.calibration_m < found.sigma_m)
    if not seen.any():
        return 0.0
    share = np.median(found.calibration_m[seen] ** 2 / (found.sigma_m[seen] ** 2 - found.calibration_m[seen] ** 2))
    room = task.objective.room
    _, variance = view_table(
        rows, room.points, room.normals, room.obstacles, room.center, room.diameter_m, room.tables, Softness().row
    )
    return float(np.sqrt(share * np.median(variance[variance > 0])))


def _of_images(rig: Rig, points: Array, weights: Array, variance: Array, displaced: Array) -> Array:
    """Return the mean square error (n, 3, 3) [m^2] of points (n, 3) by their images.

    ``weights`` (c, n) [1/px^2]: weights of the images; ``variance`` (c, n) [px^2]: their variances; ``displaced``
    (c, n, 3) [m]: displacement of the point that each image shows.
    """
    total, noise = np.zeros((2, len(points), 3, 3))
    pull = np.zeros((len(points), 3, 1))
    for camera, weight, of_image, off in zip(rig.cameras, weights, variance, displaced, strict=True):
        rows = np.flatnonzero(weight > 0)
        by_point = project_with_jacobians(camera, points[rows]).by_point
        told = np.swapaxes(by_point, 1, 2) @ by_point * weight[rows, None, None]
        total[rows] += told
        noise[rows] += told * (weight * of_image)[rows, None, None]
        pull[rows] += told @ off[rows, :, None]
    inverse = np.linalg.inv(total)
    mean = inverse @ pull
    return np.asarray(inverse @ noise @ inverse + mean @ np.swapaxes(mean, 1, 2))
