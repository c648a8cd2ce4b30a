"""The world's axes from an L-frame: its balls are found in the rig's own axes, and the rig is moved onto them."""

from collections.abc import Mapping
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
from mosca.data.rig import Pose, Rig
from mosca.data.wands import LFrame
from mosca.errors import CalibrationError

FITS = 0.01
"""Misfit of the balls, over the frame's size, up to which they are the L-frame's."""
NEAR = 0.05
"""Scale error up to which lengths are searched for as they are; beyond, any size is tried."""
WRONG_SCALE, DOUBTFUL_SCALE = 0.02, 0.001
"""Relative differences of the L-frame's lengths that are an error, and a warning."""
UNITS = {1e3: "mm for m", 1e-3: "m for mm", 1e2: "cm for m", 1e-2: "m for cm", 39.37: "inch for m"}
"""Confusions of units that explain a wrong factor of scale."""


@dataclass(frozen=True, eq=False)
class Axes:
    """A rig moved onto an L-frame's axes by ``world_from_rig``.

    ``residuals_m`` (n, 3): differences of the balls' measured centres from the L-frame's; ``measured_over_known``:
    ratio of the frame's size in the rig to that in the file, with its standard deviation (from detection, the file
    and, where given, the calibration); ``findings``: warnings.
    """

    rig: Rig
    world_from_rig: Pose
    residuals_m: Array
    measured_over_known: float
    scale_sigma: float
    findings: tuple[Finding, ...]

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the balls from their positions in the file [m]."""
        return float(np.sqrt(np.mean((self.residuals_m**2).sum(axis=1))))


def world_from_l_frame(calibration: Calibration | Rig, detections: Mapping[str, Detections], l_frame: LFrame) -> Axes:
    """Return a rig in the axes of an L-frame that ``detections`` of each camera show.

    With a ``Calibration`` its covariance is part of the size's uncertainty, with a ``Rig`` it is not.
    CalibrationError where its balls are not found in two cameras at least, in more than one way, or mirrored.
    """
    rig = calibration if isinstance(calibration, Rig) else calibration.rig
    seen = spots(rig, detections)
    places = seen.places
    known = np.asarray(l_frame.positions)
    if len(places) < len(known):
        raise CalibrationError(
            f"L-frame: {len(places)} balls found that two cameras see, {len(known)} are wanted "
            f"({', '.join(l_frame.names)}); put it where more cameras see all of it"
        )
    match = best_match(places, known, FITS, NEAR) or best_match(places, known, FITS, None)
    if match is None:
        raise CalibrationError(
            f"L-frame: none of the {len(places)} balls found lie as the file says (misfits up to {100 * FITS:g} % of "
            "its size are allowed); check the file's distances, that it is not mirrored (x and y swapped), and that "
            "nothing else shines"
        )
    balls = seen.of(match)
    found = balls.places
    ratio, slope, variance = _size(balls, known, l_frame.sigma_m)
    if isinstance(calibration, Calibration):
        by_parameter = np.einsum("ni,nik->k", slope, _moved_by(calibration, balls))
        variance += float(by_parameter @ calibration.covariance @ by_parameter)
    sigma = float(np.sqrt(variance))
    pose = rigid(found, known)
    cameras = tuple(replace(one, world_from_camera=pose @ one.world_from_camera) for one in rig.cameras)
    return Axes(Rig(cameras), pose, pose.transform(found) - known, ratio, sigma, _checked(ratio, sigma))


def in_axes(calibration: Calibration, axes: Axes) -> Calibration:
    """Return a calibration in the axes of ``axes``, its covariance carried along.

    The covariance stays that of the network itself: errors in measuring the L-frame move all cameras alike and are
    not in it.
    """
    rotation = axes.world_from_rig.rotation
    names, place = calibration.parameters, {name: k for k, name in enumerate(calibration.parameters)}
    carry = np.eye(len(names))
    for camera in axes.rig.cameras:
        at = [place.get(f"{camera.name}.{axis}_m", -1) for axis in "XYZ"]
        if min(at) < 0:
            continue
        carry[np.ix_(at, at)] = rotation
    on_thing = len(calibration.target_translation) > 0
    return replace(
        calibration,
        rig=axes.rig,
        covariance=carry @ calibration.covariance @ carry.T,
        marks_m=calibration.marks_m if on_thing else axes.world_from_rig.transform(calibration.marks_m),
        target_rotation=rotation @ calibration.target_rotation,
        target_translation=axes.world_from_rig.transform(calibration.target_translation),
        findings=calibration.findings + axes.findings,
    )


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
