"""Checks of the scale: sizes of the marks' images, plausible distances, and held-out lengths."""

from dataclasses import dataclass

import numpy as np

from mosca.calibration.common.robust_fit import SIGMA_BY_MEDIAN_1D
from mosca.calibration.quality.accuracy_map import triangulated_points
from mosca.calibration.quality.findings import refuse, warn
from mosca.calibration.quality.limits import QualityLimits
from mosca.camera.projection import project_with_jacobians
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding
from mosca.data.rig import Rig
from mosca.data.sightings import Sightings
from mosca.errors import InputError

UNITS = {
    1000.0: "millimetres for metres",
    100.0: "centimetres for metres",
    10.0: "millimetres for centimetres",
    25.4: "millimetres for inches",
    39.3701: "inches for metres",
    3.28084: "feet for metres",
    2.54: "centimetres for inches",
    12.0: "inches for feet",
}
"""Ratios that result from taking one unit for the other."""


def sizes(
    calibration: Calibration, target_diameters_m: Array | float, settings: QualityLimits
) -> tuple[Finding, ...]:
    """Return findings where the marks do not have the image size that the calibrated geometry predicts.

    ``target_diameters_m``: of each mark (m,), or one for all. The marks' positions and diameters come from one file,
    but the rig depends only on the positions: if these are wrong, the images are too large or too small.
    """
    ratio, sigma, typical_px, count = size_ratio(calibration, target_diameters_m)
    if count < 3:
        return ()
    unit = _unit(ratio, settings.unit_error)
    if unit:
        text = (
            f"the marks look {ratio:.4g} times as large as the calibrated geometry says: {unit}; give places and "
            "diameters of the target in one unit and calibrate again"
        )
        return (refuse("mixed-units", text),)
    allowed = max(settings.size_error, settings.size_bias_px / typical_px)
    if abs(ratio - 1) <= max(allowed, 3 * sigma):
        return ()
    text = (
        f"the marks look {abs(ratio - 1):.1%} (+- {sigma:.1%}) {'larger' if ratio > 1 else 'smaller'} than "
        f"the calibrated geometry says, {allowed:.1%} allowed; measure a mark and a distance between two of "
        "them: either the diameters in the target's file are wrong, or its lengths, and then every length "
        "measured with this rig is"
    )
    return (refuse("wrong-size", text),)


def distances(calibration: Calibration, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return findings where the target is at a distance that cannot be in metres."""
    see, rows = calibration.sightings, calibration.used
    centres = np.array([camera.world_from_camera.translation for camera in calibration.rig.cameras])
    away = np.linalg.norm(calibration.points_in_world() - centres[see.camera], axis=1)[rows]
    if len(away) == 0:
        return ()
    typical, (near, far) = float(np.median(away)), settings.distances_m
    if near <= typical <= far:
        return ()
    text = (
        f"the target stands {typical:.3g} m from the cameras, {near:g} to {far:g} m are plausible; is its file in "
        "millimetres? give lengths in metres and calibrate again"
    )
    return (warn("mixed-units", text),)


def size_ratio(calibration: Calibration, target_diameters_m: Array | float) -> tuple[float, float, float, int]:
    """Return the median ratio of seen to predicted image diameter, its standard deviation, the typical diameter [px]
    and the number of marks' images that have one.

    The longer axis of a disc's image equals the diameter for a disc facing the camera; a ball off the axis is a
    little longer. The median's standard deviation is 1.25 times that of a mean, from the median absolute deviation.
    """
    see = calibration.sightings
    diameter = np.broadcast_to(np.asarray(target_diameters_m, dtype=float), (len(calibration.marks_m),))
    known = calibration.used & np.isfinite(see.diameter_px)
    known[known] &= np.isfinite(diameter[see.mark[known]])
    points, ratios = calibration.points_in_world(), []
    for k, camera in enumerate(calibration.rig.cameras):
        rows = np.flatnonzero(known & (see.camera == k))
        if len(rows) == 0:
            continue
        scale = np.linalg.svd(project_with_jacobians(camera, points[rows]).by_point, compute_uv=False)[:, 1]
        ratios.append(see.diameter_px[rows] / (scale * diameter[see.mark[rows]]))
    if not ratios:
        return 1.0, 0.0, 1.0, 0
    every = np.concatenate(ratios)
    every = every[np.isfinite(every)]
    ratio = float(np.median(every))
    scatter = SIGMA_BY_MEDIAN_1D * float(np.median(np.abs(every - ratio)))
    return ratio, 1.25 * scatter / np.sqrt(len(every)), float(np.median(see.diameter_px[known])), len(every)


def _unit(ratio: float, near: float) -> str:
    for factor, words in UNITS.items():
        for one, text in ((factor, words), (1 / factor, words)):
            if abs(ratio / one - 1) < near:
                return text
    return ""


@dataclass(frozen=True, eq=False)
class LengthErrors:
    """Lengths measured with a rig, compared with the true length.

    ``frame`` (k,); ``length_m`` and ``sigma_m`` (k,) measured, with the standard deviation from detection;
    ``true_m``; ``scale_error`` mean of measured over true, minus 1; ``scale_sigma`` its standard deviation, from
    scatter, the bar's own, and the calibration's (common to all frames, so that it does not average out).
    """

    frame: Array
    length_m: Array
    sigma_m: Array
    true_m: float
    scale_error: float
    scale_sigma: float

    @property
    def rms_m(self) -> float:
        """Root mean square of the length errors [m]."""
        return float(np.sqrt(np.mean((self.length_m - self.true_m) ** 2)))


def length_errors(
    calibration: Calibration | Rig, sightings: Sightings, length_m: float, sigma_m: float = 0.0
) -> LengthErrors:
    """Measure a scale bar that the calibration did not use.

    ``sightings``: marks 0 and 1 are the bar's ends, cameras are named as in the rig; ``length_m`` +- ``sigma_m``: the
    true length. With a ``Calibration`` its covariance is included, with a ``Rig`` it is not. InputError where fewer
    than two frames show both ends in two cameras.
    """
    rig = calibration if isinstance(calibration, Rig) else calibration.rig
    camera = np.array([_index(rig, name) for name in sightings.cameras], dtype=np.int64)[sightings.camera]
    ends = (sightings.mark == 0) | (sightings.mark == 1)
    key = 2 * sightings.frame + sightings.mark
    points = triangulated_points(
        calibration, camera[ends], key[ends], sightings.xy_px[ends], sightings.covariance_px2[ends]
    )
    first = np.flatnonzero(points.key % 2 == 0)
    second = np.searchsorted(points.key, points.key[first] + 1)
    pair = (second < len(points.key)) & (points.key[np.minimum(second, len(points.key) - 1)] == points.key[first] + 1)
    first, second = first[pair], second[pair]
    if len(first) < 2:
        raise InputError(
            f"held-out lengths: {len(first)} frames show both ends of the bar in two cameras, 2 at least are needed; "
            "show the bar where two cameras see it"
        )
    apart = points.xyz[second] - points.xyz[first]
    length = np.linalg.norm(apart, axis=1)
    along = apart / length[:, None]
    both = points.covariance[first] + points.covariance[second]
    variance = np.einsum("ni,nij,nj->n", along, both, along)
    weight = 1.0 / variance
    mean = float((weight * length).sum() / weight.sum())
    spread = float((weight * (length - mean) ** 2).sum() / (len(length) - 1))
    by_parameter = np.einsum("ni,nik->nk", along, points.by_parameter[second] - points.by_parameter[first])
    common = (weight @ by_parameter) / weight.sum()
    calibrated = 0.0 if isinstance(calibration, Rig) else float(common @ calibration.covariance @ common)
    total = max(spread, 1.0) / float(weight.sum()) + calibrated + sigma_m**2
    return LengthErrors(
        points.key[first] // 2,
        length,
        np.sqrt(variance),
        length_m,
        mean / length_m - 1,
        float(np.sqrt(total)) / length_m,
    )


def scale_error(errors: LengthErrors, settings: QualityLimits | None = None) -> tuple[Finding, ...]:
    """Return a refusal where held-out lengths are wrong beyond their own uncertainty."""
    settings = settings or QualityLimits()
    unit = _unit(1 + errors.scale_error, settings.unit_error)
    if unit:
        text = (
            f"the held-out bar of {errors.true_m:g} m measures {np.mean(errors.length_m):.4g} m: {unit}; give the "
            "target's lengths in metres and calibrate again"
        )
        return (refuse("mixed-units", text),)
    allowed = max(settings.length_error, settings.length_sigmas * errors.scale_sigma)
    if abs(errors.scale_error) <= allowed:
        return ()
    text = (
        f"{len(errors.frame)} held-out lengths come out {100 * errors.scale_error:+.3f} % (+- "
        f"{100 * errors.scale_sigma:.3f} %) wrong, {100 * allowed:.3f} % allowed; measure the target (or the "
        "wand) that gave the scale, and the bar"
    )
    return (refuse("scale-error", text),)


def _index(rig: Rig, name: str) -> int:
    rig.camera(name)
    return rig.names.index(name)
