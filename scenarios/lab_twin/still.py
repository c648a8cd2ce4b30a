"""Targets at rest: a camera's blur, the targets' brightness and the camera's shake from a static recording."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mosca.accuracy.lab_twin.defocus import Defocus
from mosca.accuracy.lab_twin.estimates import SPREAD, NotTold, ParameterEstimate, Told, weighted_mean
from mosca.accuracy.lab_twin.moving_targets import turned_images
from mosca.accuracy.lab_twin.photon_transfer import ROUNDING_DN2
from mosca.accuracy.lab_twin.pixel_statistics import PixelStatistics
from mosca.accuracy.lab_twin.shake import shake_estimates
from mosca.accuracy.lab_twin.target_images import (
    FEWEST_TARGETS,
    FittedTarget,
    TargetDisplacements,
    corner_blur,
    fit_targets,
    sharper,
)
from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo
from mosca.data.rig import Rig
from mosca.detection.detect import detect
from mosca.detection.settings import DetectionSettings
from scenarios.lab_twin.focus import FOCUS_KEYS, depths_m, focused, with_focus
from scenarios.lab_twin.recordings import CameraImages, LabRecording, Progress, opened

KEYS = (
    "errors.psf_sigma_px", "errors.marker_signal", "errors.background_e", "errors.body_px", "mount.vibration_px",
    *FOCUS_KEYS,
)  # fmt: skip
CORNER = "corner_blur_px"
"""Key for information only: a scenario has one blur for all of the image, unless optics.focus_m focuses a lens."""
NEEDS = f"needs a recording of {FEWEST_TARGETS} targets at rest or more, apart from each other: static:FOLDER"
HARMONICS = 100
"""Terms of the rounding error's series: without any noise it is 0.288 DN, within 0.4 % of 1 / sqrt(12)."""
ROUNDS = 2
"""Rounds of estimating displacements: the shake, once known, is removed from the mean image's blur."""


def still_estimates(
    one: LabRecording,
    sums: Mapping[str, CameraImages],
    rig: Rig | None,
    fps: float | None,
    progress: Progress | None = None,
) -> dict[str, list[Told]]:
    """Return the estimates for each camera from targets at rest; brightness is in grey values, see ``in_well``."""
    found_in = {name: _detected(name, images.pixels) for name, images in sums.items()}
    targets = {name: fit_targets(images.pixels, found_in[name]) for name, images in sums.items()}
    seen = {name: found for name, found in targets.items() if len(found) >= FEWEST_TARGETS}
    told: dict[str, list[Told]] = {
        name: [NotTold(name, key, NEEDS) for key in KEYS] for name in sums if name not in seen
    }
    depths = {} if rig is None else depths_m(rig, found_in, seen)
    shake = dict.fromkeys(seen, 0.0)
    moved: dict[str, TargetDisplacements] = {}
    lenses: dict[str, tuple[Defocus | None, list[FittedTarget]]] = {
        name: (None, found) for name, found in seen.items()
    }
    for _ in range(ROUNDS):
        moved = _displacements(one, {name: found for name, (_, found) in lenses.items()}, shake, rig, fps, progress)
        for name, displaced in moved.items():
            common, noise = displaced.common()
            shake[name] = math.sqrt(max(float(common.var(axis=0).mean()) - noise**2, 0.0))
            if name in depths:
                lenses[name] = focused(sums[name].pixels, seen[name], depths[name], shake[name])
    for name, (defocus, found) in lenses.items():
        images = sums[name]
        common, noise = moved[name].common()
        numbers = np.array(moved[name].numbers)
        whole = np.full((numbers.max() - numbers.min() + 1, 2), np.nan)
        whole[numbers - numbers.min()] = common
        noise_dn2 = float(np.median(images.pixels.variance)) - ROUNDING_DN2
        optics = _optics(name, found, shake[name], (images.info.height, images.info.width), noise_dn2)
        told[name] = with_focus(optics, None if rig is None else rig.camera(name), defocus)
        told[name] += shake_estimates(name, whole, noise, _rate_hz(images.info, fps))
    return told


def _detected(name: str, sums: PixelStatistics) -> Detections:
    kind = np.uint8 if sums.bits <= 8 else np.uint16
    rounded = np.floor(sums.mean + 0.5).astype(kind)
    return detect(rounded, name, DetectionSettings(), sums.bits, None)


def _displacements(
    one: LabRecording,
    targets: Mapping[str, list[FittedTarget]],
    shake: Mapping[str, float],
    rig: Rig | None,
    fps: float | None,
    progress: Progress | None,
) -> dict[str, TargetDisplacements]:
    moved = {
        name: TargetDisplacements(found, shake[name], _turned(name, found, rig)) for name, found in targets.items()
    }
    done: dict[str, set[int]] = {name: set() for name in moved}
    with opened(one, rig, fps) as source:
        total = getattr(source, "n_frames", None)
        for k, frame in enumerate(source):
            if frame.camera in moved and frame.image is not None and frame.index not in done[frame.camera]:
                moved[frame.camera].add(frame.image, frame.index)
                done[frame.camera].add(frame.index)
            if progress is not None:
                progress(k + 1, total)
    return moved


def _turned(name: str, targets: list[FittedTarget], rig: Rig | None) -> Array | None:
    """Return how the camera's rotation moves the targets' images, where the rig is known."""
    return None if rig is None else turned_images(rig.camera(name), np.array([one.xy_px for one in targets]))


def _rate_hz(info: CameraInfo, fps: float | None) -> float | None:
    rate = fps or info.frame_rate_hz
    return rate if rate > 1.0 else None


def _optics(
    name: str, targets: list[FittedTarget], shake_px: float, shape: tuple[int, int], noise_dn2: float
) -> list[Told]:
    """Return blur and brightness of the targets; brightness and background are in grey values, for ``in_well``.

    ``noise_dn2``: temporal variance of a pixel of the background before rounding.
    """
    blur = np.array([sharper(one, shake_px) for one in targets])
    level = np.array([one.fit.level for one in targets])
    ground = np.array([one.ground for one in targets])
    misfit = float(np.median([one.fit.misfit for one in targets]))
    what = f"{len(targets)} targets at rest, misfit {100 * misfit:.1f} %"
    corner = corner_blur(targets, shake_px, shape)
    at_corner: Told = NotTold(name, CORNER, "needs six targets at rest or more, some far from the image's middle")
    if corner is not None:
        at_corner = ParameterEstimate(name, CORNER, *corner, f"{len(targets)} targets, by distance from the middle")
    dark = _of_targets(name, "background_dn", ground, what)
    return [
        at_corner,
        _of_targets(name, "errors.psf_sigma_px", blur, what),
        _of_targets(name, "level_dn", level, what),
        replace(dark, sigma=math.hypot(dark.sigma, mean_of_rounded_dn(noise_dn2))),
    ]


def mean_of_rounded_dn(noise_dn2: float) -> float:
    """Return the rms error [DN] of the mean of many rounded values whose noise has the variance ``noise_dn2``.

    The error is a Fourier series of the unrounded mean, with amplitudes exp(-2 (pi k)^2 noise_dn2) / (pi k); the
    mean is taken to lie anywhere between two grey values.
    """
    turn = np.pi * np.arange(1, HARMONICS + 1)
    return float(np.sqrt(np.sum(np.exp(-4.0 * turn**2 * max(noise_dn2, 0.0)) / (2.0 * turn**2))))


def _of_targets(name: str, key: str, values: np.ndarray, what: str) -> ParameterEstimate:
    """Return the mean over targets without outliers, and its standard deviation from their scatter."""
    middle = np.median(values)
    spread = SPREAD * np.median(np.abs(values - middle))
    good = values[np.abs(values - middle) <= 4.0 * spread + 1e-12]
    sigma = max(float(good.std(ddof=1)), 1e-9) if len(good) > 1 else max(abs(float(good[0])), 1e-9)
    mean, own = weighted_mean(good, np.full(len(good), sigma))
    return ParameterEstimate(name, key, mean, own, what)


def in_well(told: list[Told], bits: int) -> list[Told]:
    """Return estimates with brightness and background in a scenario's units, by black level and full well.

    A marker's signal is its grey values over those of the full well; the background is in electrons. Neither is
    estimated where the sensor is not.
    """
    known = {one.key: one for one in told if isinstance(one, ParameterEstimate)}
    level, ground = known.pop("level_dn", None), known.pop("background_dn", None)
    rest: list[Told] = [one for one in told if one.key not in ("level_dn", "background_dn")]
    if level is None or ground is None:
        return rest
    black, well = known.get("sensor.black_dn"), known.get("errors.full_well_e")
    name, scale = level.camera, 2.0 ** (bits - 8)
    if black is None:
        why = "needs a dark recording: dark:FOLDER"
        return [*rest, NotTold(name, "errors.marker_signal", why), NotTold(name, "errors.background_e", why)]
    top = 2.0**bits - 1.0 - scale * black.value
    share, sigma = level.value / top, math.hypot(level.sigma, level.value / top * scale * black.sigma) / top
    rest.append(ParameterEstimate(name, "errors.marker_signal", share, sigma, level.evidence))
    if well is None:
        return [*rest, NotTold(name, "errors.background_e", "needs a lit recording: lit:FOLDER")]
    per_dn = well.value / top
    light = (ground.value - scale * black.value) * per_dn
    own = math.hypot(per_dn * math.hypot(ground.sigma, scale * black.sigma), light * well.sigma / well.value)
    return [*rest, ParameterEstimate(name, "errors.background_e", max(light, 0.0), own, ground.evidence)]
