"""Photon transfer: dark noise, system gain, saturation capacity, DSNU and PRNU of a sensor from dark and lit images.

After EMVA 1288 (release 4.0, linear), sections 6 to 8. The temporal variance of a pixel grows linearly with its mean;
the slope is the gain K: ``var = var_dark + K (mean - mean_dark)``. Fixed patterns are the spatial variance of the
mean images after the slow part is removed, minus the part that temporal noise leaves in them. Rounding adds 1/12 to
each variance (Sheppard) if the noise is at least ``LEAST_NOISE_DN``. Below that, the scatter of all dark grey values
is estimated from the frequencies of those next to the commonest one, assuming normal distributions. It is the sum of
temporal noise and DSNU; their shares follow from how much of it a pixel shows by itself, from image to image.

Standard deviations are those of the mean over ``TILES`` parts of the image each way, so that they include the
differences between parts.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.optimize import brentq, minimize

from mosca.accuracy.lab_twin.estimates import SPREAD, NotTold, ParameterEstimate, Told, root, weighted_mean
from mosca.accuracy.lab_twin.pixel_statistics import PixelStatistics
from mosca.data.arrays import Array
from mosca.data.distributions import norm

TILES = 6
"""Parts of an image each way; the scatter of the parts gives the standard deviations."""
LEAST_NOISE_DN = 0.5
"""Noise from which rounded grey values have the noise's variance plus 1/12, to 3 %, as in ``diagnostics.sensor``."""
ROUNDING_DN2 = 1.0 / 12.0
"""Variance that rounding adds (Sheppard)."""
FEWEST_IMAGES = 4
"""Fewest images of a recording: variances of fewer images have too few degrees of freedom."""
BOX_PX = 7
"""Side of the box mean that is subtracted from a mean image before its spatial variance (EMVA 1288, 8.1)."""
HOT_SIGMAS = 8.0
"""Standard deviations above its neighbours from which a pixel is hot: of 10 million normal ones none is by chance."""
DEAD_SHARE = 0.2
"""Share of the usual response below which a pixel is dead."""
LEAST_RISE = 4.0
"""Least ratio of a lit recording's variance to the dark one's to estimate the gain."""
SEEN = 3.0
"""Standard deviations from which a pattern below rounding is stated: reached by chance in 1 of 740 without any."""
LEAST_TEMPORAL = 1e-3
"""Least temporal share of a dark variance, derived from the grid of offsets: its root is 3 of the steps."""
SATURATED_SHARE = 1e-3
"""Share of pixels at the largest grey value from which a lit recording is not used for the gain."""


@dataclass(frozen=True)
class Dark:
    """Dark level and temporal dark noise of a camera."""

    level_dn: float
    variance_dn2: float
    """Temporal variance minus that of rounding."""
    sigma_dn2: float
    """Standard deviation of ``variance_dn2``."""
    measurable: bool
    """Whether the noise is above rounding; otherwise the variance assumes a normal distribution."""
    pattern_dn2: tuple[float, float] | None = None
    """Variance of the pixels' offsets and its standard deviation, where noise is below rounding and it is seen."""


def sensor_estimates(camera: str, dark: PixelStatistics | None, lit: Sequence[PixelStatistics]) -> list[Told]:
    """Return the parameters of a sensor from dark and lit images, or what is missing to estimate them.

    ``lit``: recordings of an even surface or an open sky, one for each level of light.
    """
    if dark is not None and dark.images < FEWEST_IMAGES:
        dark = None
    usable = [one for one in lit if one.images >= FEWEST_IMAGES and not _saturated(one)]
    told: list[Told] = [_saturation(camera, lit)]
    if dark is None:
        return told + _lacking(camera, f"needs a dark recording of {FEWEST_IMAGES} images or more: dark:FOLDER")
    level = dark_level(dark)
    black = level.level_dn / 2.0 ** (dark.bits - 8)
    sigma = max(_of_mean(_tiles(dark.mean)), 1e-6) / 2.0 ** (dark.bits - 8)
    told.append(ParameterEstimate(camera, "sensor.black_dn", black, sigma, f"mean of {dark.images} dark images"))
    gain = None if not usable else system_gain(dark, level, usable)
    if gain is None:
        why = "needs a lit recording, bright and not saturated, of an even surface without targets: lit:FOLDER"
        return told + _lacking(camera, why)
    return told + _with_gain(camera, dark, level, usable, gain)


KEYS = (
    "errors.full_well_e", "errors.read_noise_e", "sensor.black_dn", "sensor.dsnu_e", "sensor.prnu",
    "sensor.hot_pixels", "sensor.dead_pixels",
)  # fmt: skip


def _lacking(camera: str, reason: str) -> list[Told]:
    keys = KEYS if "dark" in reason else tuple(key for key in KEYS if key != "sensor.black_dn")
    return [NotTold(camera, key, reason) for key in keys]


def dark_level(dark: PixelStatistics) -> Dark:
    """Return level and temporal noise of dark images."""
    variance = dark.variance
    if math.sqrt(max(float(np.median(variance)) - ROUNDING_DN2, 0.0)) >= LEAST_NOISE_DN:
        parts = _tiles(variance - ROUNDING_DN2)
        return Dark(float(dark.mean.mean()), float(np.mean(parts)), _of_mean(parts), True)
    return _below_rounding(dark)


def _below_rounding(dark: PixelStatistics) -> Dark:
    """Return level, temporal noise and pattern of dark images whose noise is below the step of rounding."""
    mean, sigma, own = normal_from_rounded(dark.histogram)
    parts = _tiles(np.where(_hot(dark), np.median(dark.variance), dark.variance))
    each, step = float(np.mean(parts)), _of_mean(parts)
    if sigma == 0.0 or step == 0.0:
        return Dark(mean, sigma**2, 2.0 * sigma * own, False)
    # a pixel's offset is the same in all images: so many values of it are fewer draws of the pattern
    alike = 1.0 - temporal_share(mean, sigma, each)
    own *= math.sqrt(1.0 + (dark.images - 1) * alike**2)
    noise = sigma**2 * (1.0 - alike)
    by_values = (sigma + own) ** 2 * temporal_share(mean, sigma + own, each) - noise
    by_pixels = sigma**2 * temporal_share(mean, sigma, each - step) - noise
    noise_sigma = math.hypot(by_values, by_pixels)
    pattern, pattern_sigma = sigma**2 - noise, math.hypot(2.0 * sigma * own - by_values, by_pixels)
    if pattern < SEEN * pattern_sigma:
        return Dark(mean, sigma**2, 2.0 * sigma * own, False)
    return Dark(mean, noise, noise_sigma, False, (pattern, pattern_sigma))


def temporal_share(mean: float, sigma: float, variance: float) -> float:
    """Return the temporal share of a normal variance ``sigma``^2 of unrounded values with mean ``mean``.

    The rest is the variance of the pixels' constant offsets. ``variance``: a pixel's own variance from image to image
    after rounding, averaged over the pixels. It falls with the share, since offsets then select the grey values.
    """
    offset = np.linspace(-6.0, 6.0, 1201)
    weight = np.exp(-0.5 * offset**2)
    weight /= weight.sum()
    reach = math.ceil(8.0 * sigma) + 1
    values = np.arange(math.floor(mean) - reach, math.floor(mean) + reach + 2)
    edges = np.append(values - 0.5, values[-1] + 0.5)

    def shown(share: float) -> float:
        own = sigma * math.sqrt(share)
        middle = mean + sigma * math.sqrt(1.0 - share) * offset[:, None]
        chances = np.diff(norm.cdf(edges, middle, own), axis=1)
        return float(weight @ (chances @ values**2 - (chances @ values) ** 2))

    if variance >= shown(1.0):
        return 1.0
    if variance <= shown(LEAST_TEMPORAL):
        return 0.0
    return float(brentq(lambda share: shown(share) - variance, LEAST_TEMPORAL, 1.0))


def normal_from_rounded(histogram: Array) -> tuple[float, float, float]:
    """Return mean, standard deviation and its uncertainty of a normal distribution, from counts of rounded values.

    Maximum likelihood; ``histogram`` (n,): how often 0, 1, 2, ... occurred. Where only one value occurred, the
    standard deviation is 0; its uncertainty is the largest noise at which no other value would occur.
    """
    values = np.flatnonzero(histogram)
    mode = int(np.argmax(histogram))
    near = np.arange(max(mode - 2, 0), min(mode + 3, len(histogram)))
    counts = histogram[near].astype(float)
    total = counts.sum()
    if len(values) == 1:
        return float(mode), 0.0, 0.5 / float(norm.isf(0.5 / total))
    edges = np.append(near - 0.5, near[-1] + 0.5)

    def loss(parameters: Array) -> float:
        chances = np.diff(norm.cdf(edges, parameters[0], math.exp(parameters[1])))
        return -float(counts @ np.log(np.maximum(chances, 1e-300)))

    mean = float(counts @ near / total)
    best = minimize(loss, [mean, math.log(0.25)], method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9})
    step = 1e-3
    mu, log = best.x
    bend = np.array([[_second(loss, best.x, i, j, (step * math.exp(log), step)) for j in range(2)] for i in range(2)])
    own = math.sqrt(max(float(np.linalg.pinv(bend)[1, 1]), 1e-12)) * math.exp(log)
    return float(mu), math.exp(log), own


def _second(loss: Callable[[Array], float], at: Array, i: int, j: int, steps: tuple[float, float]) -> float:
    """Return a second derivative of ``loss`` by central differences."""
    one, two = np.zeros(2), np.zeros(2)
    one[i], two[j] = steps[i], steps[j]
    four = loss(at + one + two) - loss(at + one - two) - loss(at - one + two) + loss(at - one - two)
    return float(four / (4.0 * steps[i] * steps[j]))


def system_gain(dark: PixelStatistics, level: Dark, lit: Sequence[PixelStatistics]) -> tuple[float, float] | None:
    """Return the gain K [DN/e-] and its standard deviation; None where no lit recording is bright enough."""
    found = []
    for one in lit:
        variance = one.variance - ROUNDING_DN2
        if float(np.median(variance)) < max(LEAST_RISE * level.variance_dn2, LEAST_NOISE_DN**2):
            continue
        gains = (_tiles(variance) - level.variance_dn2) / (_tiles(one.mean) - level.level_dn)
        rise = float(np.mean(_tiles(one.mean))) - level.level_dn
        found.append((float(np.mean(gains)), math.hypot(_of_mean(gains), level.sigma_dn2 / rise)))
    if not found:
        return None
    return weighted_mean(*zip(*found, strict=True))


def _with_gain(
    camera: str, dark: PixelStatistics, level: Dark, lit: Sequence[PixelStatistics], gain: tuple[float, float]
) -> list[Told]:
    """Return all parameters that are stated in electrons, and the fixed pattern of the response."""
    k, own = gain
    share = own / k
    top = 2.0**dark.bits - 1.0
    images = f"{dark.images} dark images, {sum(one.images for one in lit)} lit ones at {len(lit)} levels"
    hot = _hot(dark)
    pattern = _dark_pattern(camera, dark, level, k, hot)
    noise, sigma = root(level.variance_dn2 - k**2 * _dark_shot(pattern), level.sigma_dn2)
    how = "" if level.measurable else "; below rounding: under the normal law"
    well = (top - level.level_dn) / k
    told: list[Told] = [
        ParameterEstimate(camera, "errors.full_well_e", well, share * well, f"photon transfer: {images}"),
        ParameterEstimate(
            camera, "errors.read_noise_e", noise / k, math.hypot(sigma, share * noise) / k, f"{images}{how}"
        ),
    ]
    told.append(pattern)
    told += _light_pattern(camera, dark, level, lit, hot)
    n = dark.mean.size
    told.append(_counted(camera, "sensor.hot_pixels", int(hot.sum()), n, f"of {n} pixels in the dark"))
    return told


def _dark_pattern(camera: str, dark: PixelStatistics, level: Dark, gain: float, hot: Array) -> Told:
    if not level.measurable:
        if level.pattern_dn2 is None:
            return NotTold(camera, "sensor.dsnu_e", "rounding hides it: needs dark images of more bits")
        value, sigma = root(*level.pattern_dn2)
        how = f"{dark.images} dark images; below rounding: under the normal law"
        return ParameterEstimate(camera, "sensor.dsnu_e", value / gain, sigma / gain, how)
    left = float(np.mean(dark.variance[~hot])) / dark.images
    value, sigma = root(*_spatial(dark.mean, ~hot, left))
    return ParameterEstimate(camera, "sensor.dsnu_e", value / gain, sigma / gain, f"{dark.images} dark images")


def _dark_shot(pattern: Told) -> float:
    """Return the mean shot noise [e-^2] of a dark signal's pattern: the positive half of a normal distribution."""
    return pattern.value / math.sqrt(2.0 * math.pi) if isinstance(pattern, ParameterEstimate) else 0.0


def _light_pattern(
    camera: str, dark: PixelStatistics, level: Dark, lit: Sequence[PixelStatistics], hot: Array
) -> list[Told]:
    """Return PRNU and dead pixels, from the brightest lit recording."""
    bright = max(lit, key=lambda one: float(one.mean.mean()))
    offset = dark.mean if level.measurable else np.full(dark.mean.shape, level.level_dn)
    signal = bright.mean - offset
    usual = uniform_filter(signal, 4 * BOX_PX + 1, mode="nearest")
    dead = signal < DEAD_SHARE * usual
    good = ~(dead | hot)
    left = float(np.mean(bright.variance[good])) / bright.images
    if level.measurable:
        left += float(np.mean(dark.variance[good])) / dark.images
    elif level.pattern_dn2 is not None:
        left += level.pattern_dn2[0]
    value, sigma = root(*_spatial(signal, good, left))
    mean = float(signal[good].mean())
    what = f"{bright.images} lit images at {mean:.0f} DN"
    return [
        ParameterEstimate(camera, "sensor.prnu", value / mean, sigma / mean, what),
        _counted(camera, "sensor.dead_pixels", int(dead.sum()), dead.size, f"of {dead.size} pixels in {what}"),
    ]


def _spatial(image: Array, good: Array, left: float) -> tuple[float, float]:
    """Return the variance of an image's fine structure minus ``left``, and its standard deviation.

    Subtraction of the box mean removes 1/49 of white noise as well (EMVA 1288, 8.1).
    """
    fine = image - uniform_filter(np.where(good, image, np.median(image)), BOX_PX, mode="nearest")
    edge = BOX_PX // 2
    inside = fine[edge:-edge, edge:-edge][good[edge:-edge, edge:-edge]]
    # pixels with strange neighbours in the box are no fine structure
    inside = inside[np.abs(inside) < HOT_SIGMAS * SPREAD * np.median(np.abs(inside)) + 1e-12]
    variance = float(np.mean(inside**2)) / (1.0 - BOX_PX**-2)
    return variance - left, variance * math.sqrt(2.0 / inside.size)


def _hot(dark: PixelStatistics) -> Array:
    """Return which pixels (H, W) are brighter in the dark than noise and fixed pattern explain."""
    mean = dark.mean
    middle = np.median(mean)
    spread = max(SPREAD * float(np.median(np.abs(mean - middle))), math.sqrt(ROUNDING_DN2 / dark.images))
    return np.asarray(mean > middle + HOT_SIGMAS * spread)


def _counted(camera: str, key: str, count: int, n: int, evidence: str) -> ParameterEstimate:
    """Return a share with the standard deviation of a Poisson count; for a count of 0, with that of a count of 1."""
    return ParameterEstimate(camera, key, count / n, math.sqrt(max(count, 1)) / n, f"{count} {evidence}")


def _saturated(one: PixelStatistics) -> bool:
    return bool(one.histogram[-1] > SATURATED_SHARE * one.histogram.sum())


def _saturation(camera: str, lit: Sequence[PixelStatistics]) -> Told:
    """Return the grey value at which the camera saturates: the value at which pixels pile up."""
    for one in lit:
        seen = np.flatnonzero(one.histogram)
        if len(seen) and one.histogram[seen[-1]] > SATURATED_SHARE * one.histogram.sum():
            below = one.histogram[max(seen[-1] - 8, 0) : seen[-1]]
            if one.histogram[seen[-1]] > 4.0 * max(below.max(initial=0), 1):
                return ParameterEstimate(
                    camera, "saturation_dn", float(seen[-1]), 0.0, f"{one.histogram[seen[-1]]} pixels pile up there"
                )
    return NotTold(camera, "saturation_dn", "needs a lit recording with saturated pixels: lit:FOLDER")


def _tiles(image: Array) -> Array:
    """Return the means (TILES^2,) of the parts of an image."""
    rows = np.array_split(image, TILES, axis=0)
    return np.array([part.mean() for row in rows for part in np.array_split(row, TILES, axis=1)])


def _of_mean(parts: Array) -> float:
    """Return the standard deviation of the mean of parts."""
    return float(np.std(parts, ddof=1) / math.sqrt(len(parts)))
