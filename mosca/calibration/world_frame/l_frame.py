"""The world's axes from an L-frame: its balls are found in the rig's own axes, and the rig is moved onto them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mosca.calibration.common.robust_fit import rigid
from mosca.calibration.quality.accuracy_map import triangulated_points
from mosca.calibration.quality.findings import refuse, warn
from mosca.calibration.world_frame.l_frame_balls import BallCandidates, best_match, spots
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding
from mosca.data.detections import Detections
from mosca.data.rig import Camera, Pose, Rig
from mosca.data.wands import LFrame
from mosca.errors import CalibrationError

FITS = 0.01
"""Misfit of the balls, over the frame's size, up to which they are the L-frame's."""
NEAR = 0.05
"""Scale error up to which lengths are searched for as they are; beyond, any size is tried."""
WRONG_SCALE, DOUBTFUL_SCALE = 0.02, 0.001
UNITS = {1e3: "mm for m", 1e-3: "m for mm", 1e2: "cm for m", 1e-2: "m for cm", 39.37: "inch for m"}


@dataclass(frozen=True, eq=False)
class Axes:
    """A rig moved onto an L-frame's axes.

    ``world_from_rig`` the motion, applied after ``scale``; ``places`` (n, 3) measured ball centres in the new frame
    and ``residuals_m`` (n, 3) their differences from the L-frame's; ``measured_over_known``: ratio of the frame's
    size in the rig to that in the file, with its standard deviation (from detection, the file and, where given, the
    calibration) and its derivative ``by_parameter`` (u,) with respect to the calibration's parameters; ``findings``:
    warnings.
    """

    rig: Rig
    world_from_rig: Pose
    scale: float
    places: Array
    residuals_m: Array
    measured_over_known: float
    scale_sigma: float
    by_parameter: Array
    findings: tuple[Finding, ...]

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the balls from their positions in the file [m]."""
        return float(np.sqrt(np.mean((self.residuals_m**2).sum(axis=1))))


def world_from_l_frame(
    calibration: Calibration | Rig,
    detections: Mapping[str, Detections] | Sequence[Detections],
    l_frame: LFrame,
    lengths_known: bool = True,
) -> Axes:
    """Return a rig in the axes of an L-frame that all of ``detections``, one a camera, show.

    With a ``Calibration`` its covariance counts in how well the size is known, with a ``Rig`` it does not.
    ``lengths_known``: False where the rig's lengths are arbitrary (self-calibration); the L-frame then gives them.
    CalibrationError where its balls are not found in two cameras at least, in more than one way, or mirrored.
    """
    rig = calibration if isinstance(calibration, Rig) else calibration.rig
    shown = detections.values() if isinstance(detections, Mapping) else detections
    seen = spots(rig, {one.camera: one for one in shown})
    places = seen.places
    known = np.asarray(l_frame.positions)
    if len(places) < len(known):
        raise CalibrationError(
            f"L-frame: {len(places)} balls found that two cameras see, {len(known)} are wanted "
            f"({', '.join(l_frame.names)}); put it where more cameras see all of it"
        )
    match = best_match(places, known, FITS, NEAR if lengths_known else None)
    if match is None and lengths_known:
        match = best_match(places, known, FITS, None)
    if match is None:
        raise CalibrationError(
            f"L-frame: none of the {len(places)} balls found lie as the file says (misfits up to {100 * FITS:g} % of "
            "its size are allowed); check the file's distances, that it is not mirrored (x and y swapped), and that "
            "nothing else shines"
        )
    balls = seen.of(match)
    found = balls.places
    ratio, slope, variance = _size(balls, known, l_frame.sigma_m)
    by_parameter = np.zeros(0)
    if isinstance(calibration, Calibration):
        by_parameter = np.einsum("ni,nik->k", slope, _moved_by(calibration, balls))
        variance += float(by_parameter @ calibration.covariance @ by_parameter)
    sigma = float(np.sqrt(variance))
    findings = _checked(ratio, sigma) if lengths_known else ()
    scale = 1.0 if lengths_known else 1 / ratio
    pose = rigid(scale * found, known)
    moved = pose.transform(scale * found)
    cameras = tuple(replace(camera, world_from_camera=_moved(camera, pose, scale)) for camera in rig.cameras)
    return Axes(Rig(cameras), pose, scale, moved, moved - known, ratio, sigma, by_parameter, findings)


def in_axes(calibration: Calibration, axes: Axes) -> Calibration:
    """Return a calibration in the axes (and lengths) of ``axes``, its covariance carried along.

    The covariance stays that of the network in itself: how well the L-frame was measured moves all cameras alike
    and is not in it. Where the L-frame scales, the uncertainty of the scale is added: what the calibration's own
    parameters do to it goes with them.
    """
    turn, scale = axes.world_from_rig.rotation, axes.scale
    names, place = calibration.parameters, {name: k for k, name in enumerate(calibration.parameters)}
    carry = np.eye(len(names))
    stretch = np.zeros(len(names))
    for camera in axes.rig.cameras:
        at = [place.get(f"{camera.name}.{axis}_m", -1) for axis in "XYZ"]
        if min(at) < 0:
            continue
        carry[np.ix_(at, at)] = scale * turn
        stretch[at] = camera.world_from_camera.translation
    moved = axes.world_from_rig.transform(scale * np.asarray(calibration.marks_m))
    on_thing = len(calibration.target_translation) > 0
    if scale != 1.0:
        if on_thing:
            raise CalibrationError("axes: a calibration by a target of known size is not stretched")
        variance = axes.scale_sigma**2
        if len(axes.by_parameter):
            variance -= float(axes.by_parameter @ calibration.covariance @ axes.by_parameter)
            carry -= scale * np.outer(stretch, axes.by_parameter)
        rest = scale**2 * max(variance, 0.0) * np.outer(stretch, stretch)
    else:
        rest = np.zeros_like(carry)
    covariance = carry @ calibration.covariance @ carry.T + rest
    return replace(
        calibration,
        rig=axes.rig,
        covariance=covariance,
        marks_m=calibration.marks_m if on_thing else moved,
        target_rotation=turn @ calibration.target_rotation,
        target_translation=axes.world_from_rig.transform(calibration.target_translation),
        sigma_m=scale * calibration.sigma_m,
        scaled_by="the L-frame's distances" if scale != 1.0 else calibration.scaled_by,
        findings=calibration.findings + axes.findings,
    )


def _moved(camera: Camera, pose: Pose, scale: float) -> Pose:
    own = camera.world_from_camera
    return pose @ Pose(own.rotation, scale * own.translation)


def _size(balls: BallCandidates, known: Array, sigma_m: float) -> tuple[float, Array, float]:
    """Return the size of the balls' figure over the known one, its slope (n, 3) by their positions, and its variance.

    The variance is that of detection and of the file; the calibration's is not in it.
    """
    found = balls.places
    pairs = list(combinations(range(len(known)), 2))
    measured = np.array([np.linalg.norm(found[i] - found[j]) for i, j in pairs])
    true = np.array([np.linalg.norm(known[i] - known[j]) for i, j in pairs])
    ratio = float(measured @ true / (true @ true))
    # d ratio / d position of each ball
    slope = np.zeros_like(found)
    for (i, j), length, weight in zip(pairs, measured, true, strict=True):
        along = (found[i] - found[j]) / length * weight
        slope[i] += along
        slope[j] -= along
    slope /= true @ true
    variance = np.einsum("ni,nij,nj->", slope, balls.covariance, slope) + sigma_m**2 * (slope**2).sum() * ratio**2
    return ratio, slope, float(variance)


def _moved_by(calibration: Calibration, balls: BallCandidates) -> Array:
    """Return how the calibration's parameters move the positions of the balls (n, 3, u)."""
    ball, camera = np.nonzero(np.isfinite(balls.xy_px).all(axis=2))
    covariance = np.tile(balls.sigma_px**2 * np.eye(2), (len(ball), 1, 1))
    points = triangulated_points(calibration, camera, ball, balls.xy_px[ball, camera], covariance)
    moved = np.zeros((len(balls), 3, len(calibration.parameters)))
    moved[points.key] = points.by_parameter
    return moved


def _checked(ratio: float, sigma: float) -> tuple[Finding, ...]:
    off = abs(ratio - 1)
    for factor, what in UNITS.items():
        if abs(ratio / factor - 1) < NEAR:
            return (
                refuse(
                    "mixed-units",
                    f"the L-frame is {ratio:.4g} times as large as its file says, as if {what} stood "
                    "there; correct the unit in the wand's or the L-frame's file",
                ),
            )
    message = (
        f"the L-frame comes out {100 * (ratio - 1):+.3f} % (+- {100 * sigma:.3f} %) larger than its file says; "
        "measure wand and L-frame again, and correct the file that is wrong"
    )
    if off > WRONG_SCALE:
        return (refuse("scale-error", message),)
    if off > max(DOUBTFUL_SCALE, 3 * sigma):
        return (warn("scale-error", message),)
    return ()
