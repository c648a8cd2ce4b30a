"""Calibration from frames: the production entry point, whatever the target and wherever the frames come from."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeGuard, TypeVar

import numpy as np

from mosca.calibration.lens_selection import calibrated_with_best
from mosca.calibration.quality.checks import check_calibration
from mosca.calibration.quality.findings import warn
from mosca.calibration.quality.limits import QualityLimits
from mosca.calibration.quality.report_data import evidence_of
from mosca.calibration.quality.scale import LengthErrors, length_errors
from mosca.calibration.quality.target_shape import target_shape, with_shape
from mosca.calibration.quality.unit_weight import unit_weight
from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.adjust import check_lens
from mosca.calibration.single_camera.interior_orientation import LensChoice, plain_lens
from mosca.calibration.targets.read_session import Progress, read_sightings
from mosca.calibration.targets.reader import reader_of
from mosca.calibration.uncalibrated.end_order import ordered
from mosca.calibration.uncalibrated.image_points import NO_DISTANCES
from mosca.calibration.uncalibrated.single_light import calibrate_light
from mosca.calibration.uncalibrated.wand import calibrate_wand, rods_of
from mosca.calibration.world_frame.l_frame import in_axes, world_from_l_frame
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.calibration import Calibration, Finding
from mosca.data.calibration_evidence import CalibrationEvidence
from mosca.data.detections import Detections
from mosca.data.files.target_tables import CalibrationTarget
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.sightings import Sightings
from mosca.data.targets import CodedTarget, RoundTarget, ScaleBar, TestField
from mosca.data.wands import LFrame, SingleLight, Wand
from mosca.detection.detect import DetectionSettings, detect
from mosca.errors import CalibrationError, InputError
from mosca.synchronisation import assemble

BALL_SIZE_ERROR = 0.25
"""Largest relative error of the size of a ball's image: retro-reflecting foil goes dark towards the rim."""
SEED = 2005
"""Seed of the samples that find starting values; a result that the data determine does not depend on it."""

Target_co = TypeVar("Target_co", bound=CalibrationTarget, covariant=True)


@dataclass(frozen=True)
class EstimateSettings:
    """Settings of a calibration from frames."""

    lens: LensChoice = field(default_factory=LensChoice)
    """Lens model to estimate; with ``choose_lens`` the first that is tried."""
    choose_lens: bool = False
    """Take another model where it predicts held-out views better."""
    free: tuple[str, ...] | None = None
    """Lens parameters to estimate; None: all, or for a wand those that the data determine."""
    exterior_only: bool = False
    """Keep the lenses of the known rig."""
    every: int = 1
    """Read every n-th frame set."""
    reference: int | None = None
    """Frame set in which a rigid target defines the world."""
    detection: DetectionSettings = field(default_factory=DetectionSettings)
    """Settings of the detection of wands' and L-frames' balls."""
    volume: tuple[Sequence[float], Sequence[float]] | None = None
    """(low, high) [m, world] of the measuring volume."""
    leave_out_unseen: bool = False
    """Leave out cameras that saw too little of the target, and calibrate the others."""


@dataclass(frozen=True)
class Shown(Generic[Target_co]):
    """A target, and the function that opens the frames showing it, given the rig known by then (None: none)."""

    target: Target_co
    opened: Callable[[Rig | None], FrameSource]


def calibrate_session(
    shown: Shown[CalibrationTarget],
    settings: EstimateSettings,
    *,
    axes: Shown[LFrame] | None = None,
    lengths: Shown[ScaleBar] | None = None,
    known: Rig | None = None,
    sightings: Sightings | None = None,
    made_from: str = "",
    progress: Progress | None = None,
) -> tuple[Calibration, CalibrationEvidence]:
    """Calibrate from frames of a target, set the axes by an L-frame, test the rig on a certified bar, and check its
    quality.

    ``axes``, ``lengths``: frames of L-frame and bar, if any; ``known``: an earlier rig of these cameras to compare
    with, whose lenses are kept with ``settings.exterior_only``; ``sightings``: sightings of the target, if they are
    known already, so that no frames are opened; ``made_from``: description of the input for the report. Returns
    the checked calibration and the evidence for the report. Raises InputError or CalibrationError where the frames do
    not suffice.
    """
    start = known if settings.exterior_only else None
    if sightings is not None:
        calibration = calibrate_sightings(sightings, shown.target, settings, start)
    else:
        with shown.opened(known) as source:
            calibration = calibrate_frames(source, shown.target, settings, start, progress)
    if axes is not None:
        with axes.opened(calibration.rig) as source:
            calibration = on_axes(calibration, source, axes.target, settings)
    errors = None
    if lengths is not None:
        with lengths.opened(calibration.rig) as source:
            errors = held_out_lengths(calibration, source, lengths.target, settings)
    calibration = checked(calibration, shown.target, settings, known=known, lengths=errors)
    calibration = replace(calibration, rig=with_residuals(calibration))
    evidence = evidence_of(
        calibration, volume=settings.volume, lengths=errors, made_from=made_from, rigid_target=is_rigid(shown.target)
    )
    return calibration, evidence


def with_residuals(calibration: Calibration) -> Rig:
    """Return the rig whose cameras state the residual error of their lens models, and their shake.

    For a stationary target the residual error is the systematic error. Otherwise it is the scatter beyond the
    detections' own, since ``sigma_px`` of an image coordinate also contains detection noise. The shake of whole
    images is not part of it.
    """
    sightings, cameras = calibration.sightings, []
    shake_px = float(np.nan_to_num(calibration.body_px))
    for k, camera in enumerate(calibration.rig.cameras):
        if len(calibration.lasting_px) and np.isfinite(calibration.lasting_px[k]):
            residual_px = float(calibration.lasting_px[k])
        else:
            mine = calibration.used & (sightings.camera == sightings.cameras.index(camera.name))
            noise = np.trace(sightings.covariance_px2[mine], axis1=1, axis2=2) / 2
            left = float(np.mean(calibration.sigma_px[k] ** 2) - np.mean(noise)) if mine.any() else 0.0
            residual_px = math.sqrt(left) if left > 0 else 0.0
        cameras.append(replace(camera, residual_px=residual_px, shake_px=shake_px))
    return Rig(tuple(cameras))


def calibrate_frames(
    source: FrameSource,
    target: CalibrationTarget,
    settings: EstimateSettings | None = None,
    known: Rig | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate the cameras of a source whose frames show ``target``; not checked yet, see ``checked``.

    ``known``: an earlier calibration of these cameras, to start from. The world is the target's frame at its first
    pose; for a wand, close to the frame of one camera (see ``on_axes``). Raises InputError or CalibrationError where
    the frames do not suffice.
    """
    settings = settings or EstimateSettings()
    _check(target, settings)
    reader = reader_of(target, settings.detection)
    sightings = read_sightings(source, reader, settings.every, progress)
    try:
        return calibrate_sightings(sightings, target, settings, known)
    except CalibrationError as error:
        if not (advice := reader.advice()):
            raise
        raise CalibrationError(f"{error}{advice}", error.unseen) from None


def calibrate_sightings(
    sightings: Sightings, target: CalibrationTarget, settings: EstimateSettings, known: Rig | None = None
) -> Calibration:
    """Calibrate from sightings of ``target``; see ``calibrate_frames``."""
    _check(target, settings)
    left_out: list[Finding] = []
    while True:
        try:
            found = _calibrated(sightings, target, settings, known)
        except CalibrationError as error:
            others = set(sightings.cameras) - set(error.unseen)
            if not error.unseen or not others:
                raise
            if not settings.leave_out_unseen:
                names = ", ".join(error.unseen)
                text = f"{error}; or calibrate without {names}: --leave-out-unseen"
                raise CalibrationError(text, error.unseen) from None
            left_out += [warn("left-out", f"camera '{name}' is left out: {error}", name) for name in error.unseen]
            sightings = sightings.without(error.unseen)
        else:
            return replace(found, findings=(*found.findings, *left_out))


def _calibrated(
    sightings: Sightings, target: CalibrationTarget, settings: EstimateSettings, known: Rig | None
) -> Calibration:
    def with_model(model: str) -> Calibration:
        lens = replace(settings.lens, model=model)
        if is_rigid(target):
            rigid = RigidSettings(
                lens, settings.free, exterior_only=settings.exterior_only, reference=settings.reference
            )
            shown = rigid_target(target)
            found = calibrate_rigid(sightings, shown, rigid, known)
            if isinstance(target, TestField) or target.sigma_m > 0:
                return found
            return with_shape(
                found, lambda sigma: calibrate_rigid(sightings, replace(shown, sigma_m=sigma), rigid, known)
            )
        lenses = [
            plain_lens(lens.of(name), 1.0, (int(w), int(h)))
            for name, (w, h) in zip(sightings.cameras, sightings.sizes, strict=True)
        ]
        rng = np.random.default_rng(SEED)
        if isinstance(target, SingleLight):
            return calibrate_light(sightings, target, rng, lenses, settings.free)
        assert isinstance(target, Wand)
        return calibrate_wand(sightings, target, rng, lenses, settings.free)

    if not (is_rigid(target) or isinstance(target, Wand | SingleLight)):
        raise InputError(
            f"a {type(target).__name__} does not calibrate cameras; give a test field, a board, a wand or a light"
        )
    if not settings.choose_lens:
        return with_model(settings.lens.model)
    rods = None
    if isinstance(target, Wand):
        rods = rods_of(target, sightings.frames)
    elif isinstance(target, SingleLight):
        rods = NO_DISTANCES
    return calibrated_with_best(with_model, settings.lens, rods)


def _check(target: CalibrationTarget, settings: EstimateSettings) -> None:
    if isinstance(target, Wand | SingleLight) and settings.exterior_only:
        name = "wand" if isinstance(target, Wand) else "light"
        raise InputError(f"a {name} does not give exterior orientation alone; show the test field or the board again")
    if settings.choose_lens and (settings.exterior_only or settings.free is not None):
        raise InputError("lens parameters are named, or lenses kept: name their model, too")
    if settings.free is not None:
        if settings.exterior_only:
            raise InputError("'free' names lens parameters, and exterior orientation alone has none; leave it out")
        check_lens("cameras", settings.lens.model, settings.free)
        focal = {"c_mm"} if settings.lens.model == "mosca" else {"fx_px", "fy_px"}
        if isinstance(target, Wand | SingleLight) and not focal <= set(settings.free):
            wanted, name = " and ".join(sorted(focal)), "wand" if isinstance(target, Wand) else "light"
            raise InputError(
                f"'free' is {', '.join(settings.free)}; of a {name}'s cameras {wanted} must be estimated"
            )


def checked(
    calibration: Calibration,
    target: CalibrationTarget,
    settings: EstimateSettings | None = None,
    *,
    known: Rig | None = None,
    lengths: LengthErrors | None = None,
) -> Calibration:
    """Return the calibration with the findings of the quality checks.

    ``known``: an earlier calibration of the same cameras to compare with; ``lengths``: held-out lengths.
    """
    settings = settings or EstimateSettings()
    limits = QualityLimits(size_error=BALL_SIZE_ERROR) if isinstance(target, Wand) else QualityLimits()
    found = check_calibration(
        calibration,
        known=known,
        target_diameters_m=_diameters_m(calibration, target),
        lengths=lengths,
        volume=settings.volume,
        rigid_target=is_rigid(target),
        settings=limits,
    )
    shape = target_shape(calibration) if isinstance(target, Board) else ()
    weight = unit_weight(calibration, (*calibration.findings, *found, *shape), limits)
    return replace(calibration, findings=(*calibration.findings, *found, *shape, *weight))


def on_axes(calibration: Calibration, source: FrameSource, frame: LFrame, settings: EstimateSettings) -> Calibration:
    """Return the calibration in the axes of an L-frame, which is stationary in the source's frames."""
    axes = world_from_l_frame(calibration, _mean_detections(source, settings), frame)
    return in_axes(calibration, axes)


def held_out_lengths(
    calibration: Calibration | Rig, source: FrameSource, bar: ScaleBar, settings: EstimateSettings
) -> LengthErrors:
    """Return the length errors of a certified bar in the source's frames, measured with a calibrated rig."""
    sightings = read_sightings(source, reader_of(bar, settings.detection), settings.every)
    rig = calibration if isinstance(calibration, Rig) else calibration.rig
    lenses = [rig.camera(name).lens for name in sightings.cameras]
    # the ends of a bar of balls must be numbered alike in all cameras
    sightings = ordered(sightings, len(bar.ends), lenses, np.random.default_rng(SEED))
    return length_errors(calibration, sightings, bar.length_m, bar.sigma_m)


def is_rigid(target: CalibrationTarget) -> TypeGuard[TestField | Board]:
    """Return whether the positions of all marks on the target are known a priori, so that the target joins them."""
    return isinstance(target, TestField | Board)


def rigid_target(target: TestField | Board) -> RigidTarget:
    """Return the marks of a test field or a board."""
    if isinstance(target, Board):
        return RigidTarget("board", target.corners(), target.sigma_m)
    return RigidTarget(
        "test field",
        target.positions,
        target.sigma_m,
        np.array([placed.normal for placed in target.targets]),
        np.array([_radius_m(placed.target) for placed in target.targets]),
    )


def _radius_m(target: object) -> float:
    match target:
        case CodedTarget(dot_radius_m=radius) | RoundTarget(radius_m=radius):
            return radius
    raise InputError("a test field holds coded targets and plain discs; balls belong on a wand or an L-frame")


def _diameters_m(calibration: Calibration, target: CalibrationTarget) -> Array | float | None:
    """Return the true diameters of the calibration's marks, None where they have none."""
    if isinstance(target, TestField):
        return np.array([2 * _radius_m(placed.target) for placed in target.targets])
    if isinstance(target, Wand):
        return target.diameter_m
    return None


def _mean_detections(source: FrameSource, settings: EstimateSettings) -> dict[str, Detections]:
    """Return the mean detections of stationary targets, by camera.

    Those of the image with most detections, of a camera's first half, are followed by nearness; targets that are
    missing in half of the images are left out.
    """
    images: dict[str, list[Detections]] = {info.name: [] for info in source.cameras}
    depth = {info.name: info.bit_depth for info in source.cameras}
    for frame_set in assemble(source, source.cameras):
        for name, frame in frame_set.frames.items():
            if frame.image is not None:
                images[name].append(detect(frame.image, name, settings.detection, depth[name]))
    found = {name: _mean(name, every) for name, every in images.items() if every}
    if not any(len(one) for one in found.values()):
        raise CalibrationError("few-views: nothing is seen of the L-frame; check exposure and detection settings")
    return found


def _mean(name: str, every: list[Detections]) -> Detections:
    first = max(every[: len(every) // 2 + 1], key=len)
    if len(first) == 0:
        return Detections.none(name)
    sums, counts = np.zeros((len(first), 2)), np.zeros(len(first))
    for one in every:
        if len(one) == 0:
            continue
        apart = np.linalg.norm(first.xy_px[:, None] - one.xy_px[None], axis=2)
        nearest = apart.argmin(axis=1)
        near = apart[np.arange(len(first)), nearest] < 0.25 * first.diameter_px
        sums[near] += one.xy_px[nearest[near]]
        counts += near
    kept = counts >= len(every) / 2
    return Detections(
        name,
        sums[kept] / counts[kept, None],
        np.asarray(first.covariance_px2)[kept] / counts[kept, None, None],
        *(np.asarray(getattr(first, key))[kept] for key in ("diameter_px", "peak", "elongation")),
    )
