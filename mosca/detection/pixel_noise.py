"""The pixel noise of each camera for detection: given by the settings, or learned from its images.

``var(I) = dark + gain (I - background)`` (EMVA 1288). The dark part is that of the background's pixels
(``mosca.detection.local_background``): dark noise, quantisation and the photon noise of the background. The gain is
learned by photon transfer from the residuals of fitted discs (``mosca.detection.disc_fit.residual_noise``). Squared
differences of opposite points are fitted by weighted least squares as the gain times the signal ``A e``, plus a share
of ``(A e')^2`` for a misfit of the edge that is not symmetric.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.data.distributions import norm
from mosca.data.settings import DetectionSettings
from mosca.detection.disc_fit.camera_statistics import CameraStatistics
from mosca.detection.disc_fit.light_offset import AMPLITUDE_SUMS, NOISE_SUMS, StatisticsSums
from mosca.detection.local_background import ROUNDING_DN2, LocalBackground, cell_grid, measure_background
from mosca.detection.search import SEARCH_SIGMAS
from mosca.detection.settings import search_of

TOLD_APART = 2.0
"""Standard deviations that a gain must have to be separated from a misfit of the edge."""
GUESSED_DARK_E = 12.0
"""Dark noise [e] from which the gain of a camera without residuals is guessed, with a standard deviation of 100 %
(EMVA 1288 sheets of CMOS sensors: 2 to 40)."""
GAIN_STEP = 0.1
"""Images without earlier statistics are searched twice where their residuals change a gain by more than this
share."""


class PixelNoise(NamedTuple):
    """Noise and background of n images of one size, in grey values [DN]."""

    gains: Array
    """(n,) DN an electron."""
    levels: Array
    """(n, rows, columns) background of each cell [DN]."""
    variances: Array
    """(n, rows, columns) variance of a pixel without light from a target [DN^2]."""
    textures: Array
    """(n, rows, columns) variance of the background's texture about a smooth background [DN^2]."""
    sigmas: float
    """Least height of a target's brightest pixel above the background, in standard deviations."""


@lru_cache
def peak_sigmas(false_alarms: float, n_px: int) -> float:
    """Return how many standard deviations noise of ``n_px`` pixels exceeds ``false_alarms`` times an image."""
    return float(norm.isf(min(false_alarms / n_px, 0.5)))


def gain_of(sums: StatisticsSums, k: int, dark_dn2: float) -> tuple[float, float]:
    """Return the gain of camera k [DN/e] and its standard deviation, from a guess and the residuals so far.

    It is the slope of the variance at the targets' brightness, which fits need. It includes all noise that grows with
    a target's light, also that of pixels' uneven response. ``mosca.diagnostics.sensor.gain_estimate`` returns the
    photons' part.
    """
    guess = np.sqrt(dark_dn2) / GUESSED_DARK_E
    ss, sq, _, qq, _, _, rs, rq, _, _ = sums.tallies[k, NOISE_SUMS:AMPLITUDE_SUMS].tolist()
    ss, rs = ss + 1 / guess**2, rs + 1 / guess
    det = ss * qq - sq * sq
    misfit = (ss * rq - sq * rs) / det if det > 1e-12 * ss * qq else -1.0
    if misfit > 0.0:
        gain, information = (qq * rs - sq * rq) / det, det / qq
        # separated from an error of the edge; else all counts as noise
        if gain > TOLD_APART * information**-0.5:
            return gain, information**-0.5
    return max(rs / ss, 1e-3 * guess), ss**-0.5


def measured_backgrounds(
    images: Sequence[Array],
    subtracted: Sequence[Array | None],
    names: tuple[str, ...],
    settings: DetectionSettings,
    known: CameraStatistics,
    refresh: Collection[str] = (),
) -> dict[str, LocalBackground]:
    """Return the backgrounds that these images show, by camera: those not known yet and those to ``refresh``.

    ``subtracted``: what is taken off an image (H, W) first [DN]. Values below zero are kept here: without them half
    of the noise would be lost.
    """
    if settings.thresholds == "paper" and settings.read_noise_dn is not None:
        return {}
    return {
        name: measure_background(
            np.ascontiguousarray(image) if background is None else np.rint(image - background).astype(np.int32),
            settings.maximum_size_px,
            None if background is not None else known.backgrounds.get(name),
        )
        for image, background, name in zip(images, subtracted, names, strict=True)
        if name in refresh
        or name not in known.backgrounds
        or known.backgrounds[name].level.shape != cell_grid(image.shape, settings.maximum_size_px)
    }


def gains_changed(before: CameraStatistics, added: CameraStatistics, settings: DetectionSettings) -> list[int]:
    """Return the numbers, among those of ``added``, of the cameras whose gain it changes by more than ``GAIN_STEP``.

    Only cameras whose background ``added`` holds are looked at. The result for one camera does not depend on the
    others.
    """
    if settings.gain_dn_per_e is not None or not added.backgrounds:
        return []
    after, changed = before.plus(added), []
    for k, name in enumerate(added.names):
        if name not in added.backgrounds:
            continue
        dark = after.backgrounds[name].usual_variance
        one, two = (_gain_of(part, name, dark) for part in (before, after))
        if abs(two - one) > GAIN_STEP * one:
            changed.append(k)
    return changed


def _gain_of(statistics: CameraStatistics, name: str, dark_dn2: float) -> float:
    """Return a camera's gain [DN/e], guessed where nothing is known."""
    if name not in statistics.names:
        return float(np.sqrt(dark_dn2)) / GUESSED_DARK_E
    return gain_of(statistics.sums, statistics.names.index(name), dark_dn2)[0]


def noise_of_set(
    statistics: CameraStatistics, names: tuple[str, ...], settings: DetectionSettings, like: Array, full_dn: float
) -> tuple[PixelNoise, list[Array]]:
    """Return the noise of a frame set's images, and for each the grey values (H, W) above which pixels are looked at.

    ``like``: one of the images, all of one size and type.
    """
    scale = (full_dn + 1.0) / 256.0
    key = (names, settings, like.shape, like.dtype, full_dn)
    return statistics.kept(key, lambda: _noise_of_set(statistics, names, settings, like, scale))


def _noise_of_set(
    statistics: CameraStatistics, names: tuple[str, ...], settings: DetectionSettings, like: Array, scale: float
) -> tuple[PixelNoise, list[Array]]:
    each = [_noise_of(statistics.of(name), name, settings, like, scale) for name in names]
    gains, backgrounds, limits = zip(*each, strict=True)
    noise = PixelNoise(
        np.array(gains),
        np.array([background.level for background in backgrounds]),
        np.array([background.variance for background in backgrounds]),
        np.array([background.texture for background in backgrounds]),
        peak_sigmas(settings.false_alarms, like.size),
    )
    return noise, list(limits)


def _noise_of(
    statistics: CameraStatistics, name: str, settings: DetectionSettings, like: Array, scale: float
) -> tuple[float, LocalBackground, Array]:
    """Return gain, background and limits of one camera."""
    key = (name, settings, like.shape, like.dtype, scale)
    return statistics.kept(key, lambda: _made_noise(statistics, name, settings, like, scale))


def _made_noise(
    statistics: CameraStatistics, name: str, settings: DetectionSettings, like: Array, scale: float
) -> tuple[float, LocalBackground, Array]:
    cells = cell_grid(like.shape, settings.maximum_size_px)
    background = statistics.backgrounds.get(
        name, LocalBackground(np.zeros(cells), np.full(cells, ROUNDING_DN2), np.zeros(cells), 1)
    )
    if settings.read_noise_dn is not None:
        told_dn2 = (settings.read_noise_dn * scale) ** 2 + ROUNDING_DN2
        background = replace(background, variance=np.full(cells, told_dn2), _limits={})
    if settings.gain_dn_per_e is not None:
        gain = settings.gain_dn_per_e * scale
    else:
        gain = _gain_of(statistics, name, background.usual_variance)
    if settings.thresholds == "paper":
        limits = np.full(like.shape, search_of(settings, round(8 + np.log2(scale))).lowest + 1, like.dtype)
    else:
        limits = background.limits(SEARCH_SIGMAS, like.shape, like.dtype, as_if_known=True)
    return gain, background, limits
