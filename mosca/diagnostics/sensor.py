"""Properties of each camera's sensor from its images, with 95 % intervals, and what was seen in them but left out.

They are estimated from the sums that detection itself uses (``mosca.detection.pixel_noise``), in the terms of EMVA
1288:

- noise [DN]: standard deviation of a pixel without light from a target, less rounding: dark noise, fixed pattern and
  photon noise of the background. Not measurable below half a grey value (EMVA 1288, 6.6, has 0.4 for levels that are
  spread evenly between two grey values; a background may lie just between two);
- gain K [DN/e-], by photon transfer from the residuals of fitted discs;
- blur [px], standard deviation of the discs' edges.

Intervals. The gain is a weighted least-squares estimate, the blur a weighted mean. Their sums are kept in blocks of
consecutive frame sets. The variance follows from the weights (how many residuals there are), or from the scatter of
blocks about the estimate (White 1980; Liang and Zeger 1986), with Student's t, where that is larger and there are
``FEWEST_BLOCKS``. The noise is the median of cells. Its variance follows from the scatter of cells, is at least that
of chi-square, and is scaled by the ratio of Birge (1932) where measurements at different times differ by more. An
interval covers chance alone: the effect of a disc's misfit (limbs, blur that is no Gaussian) on the gain is the same
in each block.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.distributions import norm, poisson
from mosca.data.distributions import t as student
from mosca.data.frames import CameraInfo, FrameSet
from mosca.detection.disc_fit.camera_statistics import CameraStatistics
from mosca.detection.disc_fit.light_offset import (
    AMPLITUDE_SUMS,
    BLUR_SUM,
    BLUR_WEIGHT,
    LEFT_OUT,
    N_TALLIES,
    N_TARGETS,
    NOISE_SUMS,
)
from mosca.detection.local_background import ROUNDING_DN2, STRIDE_PX, LocalBackground
from mosca.detection.pixel_noise import peak_sigmas
from mosca.detection.search import LEFT_OUT_REASONS
from mosca.detection.settings import DEFAULTS, DetectionSettings

LEAST_NOISE_DN = 0.5
"""Noise from which the variance of rounded grey values equals that of the noise plus 1/12 to within 3 %, wherever
between two grey values their mean lies (the neglected terms fall with exp(-2 pi^2 noise^2): 20 % at 0.4, 90 % at
0.3)."""
DIGEST_SETS = 32
"""Frame sets that are added up at a time: one by one takes longer."""
MOST_BLOCKS, FEWEST_BLOCKS = 64, 8
"""Most blocks of frame sets that are kept, beyond which neighbours are joined, and fewest whose scatter counts: with
fewer, the scatter itself is uncertain by more than 25 %."""
CONFIDENCE = 0.95
"""Confidence of all intervals."""
MEDIAN_LOSS = 0.5 * math.pi
"""Variance of a normal sample's median over that of its mean."""
FILTERED_CELLS = 9
"""Cells of which each noise figure is the median: so many times fewer are independent."""
NOTABLE = 0.05
"""Share of what was seen in a camera's images that may be left out without a message."""
BY_CHANCE = 1e-3
"""Probability that noise alone makes so many left-out spots, below which they are reported."""
NORMAL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Indices of the normal matrix in the sums of photon transfer; the right side follows."""
MISFIT_PX2 = 1.0
"""Prior standard deviation of q's share, the edge's error squared, about 0 [px^2]: images determine it better."""
UNEVEN = 1e-4
"""Prior standard deviation of u's share about 0, or the share found where that is larger: (1 %)^2, as data sheets
(EMVA 1288) state a PRNU of 0.3 to 1.5 %. Few images do not separate u from s: with ten times as much, 8 images of 35
targets give intervals three times as wide as the gain; with a tenth, a PRNU of 1 % makes the gain 12 % too large
there."""
PASSES = 6
"""Solutions of the gain; in each, u's prior is as wide as the u found before."""
SAMPLED_PX = 8_192
"""Approximate number of pixels of an image whose bits are examined."""


@dataclass(frozen=True)
class Estimate:
    """A figure and its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class LearnedSensor:
    """Properties of a sensor from one camera's images; grey values [DN] are its own."""

    name: str
    images: int
    """Images that it was learned from."""
    targets: int
    """Discs that were fitted to single targets."""
    residuals: int
    """Pixels of these from which the gain was estimated."""
    noise_dn: Estimate | None
    """Noise of a pixel without light from a target, less rounding; only an upper bound (``low`` is 0) where it is not
    measurable, None where it was not measured."""
    gain_dn_per_e: Estimate | None
    """System gain K; None: no target determined it, or misfits of the discs hide it."""
    blur_px: Estimate | None
    background_dn: float | None
    """Median grey value without targets."""
    bits: int
    """Significant bits, as the source states them."""
    step_dn: int
    """Power of two by which all grey values can be divided: more than 1 where the lower bits hold nothing."""
    peak_dn: float
    """Median of the targets' largest grey values; 0 without any."""
    largest_dn: int
    """The largest of these."""
    saturated: float
    """Share of targets with pixels at the largest grey value that ``bits`` can give."""
    found: int
    """Targets in all images."""
    left_out: Mapping[str, int]
    """What was seen but is no target, by ``mosca.detection.search.LEFT_OUT_REASONS``."""

    @property
    def saturation_dn(self) -> int | None:
        """Grey value at which the camera saturates; None where no target reached it."""
        return 2**self.bits - 1 if self.saturated > 0.0 else None

    @property
    def noise_measurable(self) -> bool:
        """Whether the noise is large enough to be measured despite rounding."""
        return self.noise_dn is not None and self.noise_dn.low > 0.0


class Sensors:
    """What is learned of the cameras' sensors while a pipeline runs. ``attend`` takes each frame set.

    Parameters
    ----------
    cameras
        Of the source: names, sizes and bits.
    settings
        Settings with which targets are detected.
    """

    def __init__(self, cameras: Sequence[CameraInfo], settings: DetectionSettings = DEFAULTS) -> None:
        self._settings = settings
        self._cameras = {info.name: _Camera(info) for info in cameras}
        self._waiting: list[tuple[dict[str, Array], tuple[str, ...], Array, Mapping[str, LocalBackground]]] = []
        """For each frame set: largest grey values of each camera's targets; names, tallies and backgrounds that it
        adds."""

    def attend(self, frame_set: FrameSet, detections: Mapping[str, Detections], added: CameraStatistics) -> None:
        """Take a frame set's images, their detections, and what they add to the cameras' statistics, in order."""
        if not self._waiting:  # one in DIGEST_SETS
            for name, frame in frame_set.frames.items():
                if frame.image is not None and name in self._cameras:
                    self._cameras[name].look_at(frame.image)
        peaks = {name: found.peak for name, found in detections.items()}
        self._waiting.append((peaks, added.names, added.sums.tallies, added.backgrounds))
        if len(self._waiting) >= DIGEST_SETS:
            self._digest()

    def cameras(self) -> tuple[LearnedSensor, ...]:
        """Return what was learned of each camera that sent images."""
        self._digest()
        return tuple(one.learned() for one in self._cameras.values() if one.images)

    def lines(self) -> tuple[str, ...]:
        """Return what was learned in words, a line a camera."""
        return tuple(sensor_line(one) for one in self.cameras())

    def findings(self) -> tuple[str, ...]:
        """Return what was seen but left out, one line for each camera where it is notable."""
        lines = []
        for one in self.cameras():
            info = self._cameras[one.name].info
            if line := left_out_line(one, self._settings, (info.height, info.width)):
                lines.append(line)
        return tuple(lines)

    def _digest(self) -> None:
        waiting, self._waiting = self._waiting, []
        for name, camera in self._cameras.items():
            own = [
                (peaks[name], tallies[names.index(name)], backgrounds.get(name))
                for peaks, names, tallies, backgrounds in waiting
                if name in names and name in peaks
            ]
            if own:
                camera.add(*zip(*own, strict=True))


class _Camera:
    """Sums of one camera."""

    def __init__(self, info: CameraInfo) -> None:
        self.info = info
        self.images = self._found = 0
        self._peaks = np.zeros(2**info.bit_depth, np.int64)
        self._blocks = np.zeros((MOST_BLOCKS, N_TALLIES))
        self._bits = 0
        self._filled, self._length = 0, 1
        """Frame sets in all blocks, and in each block."""
        self._backgrounds: list[tuple[float, float, float]] = []
        """Level, variance and its standard deviation of each measurement."""

    def look_at(self, image: Array) -> None:
        """Record which bits are set in the pixels of an image (H, W)."""
        rows = np.ascontiguousarray(image[:: max(1, image.size // SAMPLED_PX)])
        self._bits |= int(np.bitwise_or.reduce(rows.ravel()))

    def add(
        self, found: Sequence[Array], tallies: Sequence[Array], backgrounds: Sequence[LocalBackground | None]
    ) -> None:
        """Add the largest grey values (n,) of images' targets, tallies (N_TALLIES,) and backgrounds."""
        peaks = np.concatenate(found).astype(np.int64)
        self.images += len(found)
        self._found += len(peaks)
        most = len(self._peaks)
        self._peaks += np.bincount(np.minimum(peaks, most - 1), minlength=most)
        for tally in tallies:
            if self._filled == MOST_BLOCKS * self._length:
                self._blocks[: MOST_BLOCKS // 2] = self._blocks[0::2] + self._blocks[1::2]
                self._blocks[MOST_BLOCKS // 2 :] = 0.0
                self._length *= 2
            self._blocks[self._filled // self._length] += tally
            self._filled += 1
        pixels = self.info.width * self.info.height
        self._backgrounds += [background_figures(one, pixels) for one in backgrounds if one is not None]

    def learned(self) -> LearnedSensor:
        """Return the properties that follow from these sums."""
        blocks = self._blocks[: -(-self._filled // self._length)]
        total = blocks.sum(axis=0)
        seen = np.flatnonzero(self._peaks)
        half = np.searchsorted(np.cumsum(self._peaks), 0.5 * self._found)
        levels = [level for level, _, _ in self._backgrounds]
        blur = None
        if total[BLUR_WEIGHT] > 0.0:
            blur, _ = _weighted(blocks[:, [BLUR_WEIGHT]][:, :, None], blocks[:, [BLUR_SUM]], np.zeros((1, 1)))
        return LearnedSensor(
            self.info.name,
            self.images,
            int(total[N_TARGETS]),
            int(total[AMPLITUDE_SUMS - 1]),
            noise_estimate([(variance, sigma) for _, variance, sigma in self._backgrounds]),
            gain_estimate(blocks[:, NOISE_SUMS : AMPLITUDE_SUMS - 1]),
            blur,
            float(np.mean(levels)) if levels else None,
            self.info.bit_depth,
            self._bits & -self._bits or 1,
            float(half) if len(seen) else 0.0,
            int(seen[-1]) if len(seen) else 0,
            int(self._peaks[-1]) / max(self._found, 1),
            self._found,
            {reason: int(n) for reason, n in zip(LEFT_OUT_REASONS, total[LEFT_OUT:], strict=True)},
        )


def gain_estimate(blocks: Array) -> Estimate | None:
    """Return the gain [DN/e-] from the photon-transfer sums (b, 9) of blocks of frame sets.

    ss, sq, su, qq, qu, uu, rs, rq, ru of ``mosca.detection.disc_fit.residual_noise``. None where no residual
    determines the gain, and where it comes out below zero: then misfits of the discs outweigh the photon noise. The
    shares of q and u are kept even where they come out below zero, which happens by chance every other time where
    discs fit. ``mosca.detection.pixel_noise.gain_of`` leaves them out then, to be safe with single images; this makes
    the gain too small on average.
    """
    if not blocks[:, 0].sum() > 0.0:
        return None
    uneven = UNEVEN
    for _ in range(PASSES):
        prior = np.diag([0.0, MISFIT_PX2**-2, uneven**-2])
        gain, solution = _weighted(blocks[:, NORMAL], blocks[:, 6:], prior)
        uneven = max(UNEVEN, solution[2])
    return gain if gain.value > 0.0 else None


def _weighted(normal: Array, right_side: Array, prior: Array) -> tuple[Estimate, Array]:
    """Return the first of p unknowns of a weighted least-squares fit from the sums of b blocks, and all of them.

    ``normal`` (b, p, p), ``right_side`` (b, p), with weights that are inverse variances; ``prior`` (p, p) information
    that the unknowns are 0.
    """
    whole = normal.sum(axis=0) + prior
    b, p = right_side.shape
    inverse = np.linalg.inv(whole)
    solution = inverse @ right_side.sum(axis=0)
    reach = norm.ppf(0.5 + 0.5 * CONFIDENCE) * math.sqrt(inverse[0, 0])
    if b >= FEWEST_BLOCKS:
        scores = right_side - normal @ solution
        scatter = inverse @ (scores.T @ scores) @ inverse * (b / (b - p))
        reach = max(reach, student.ppf(0.5 + 0.5 * CONFIDENCE, b - p) * math.sqrt(scatter[0, 0]))
    value = float(solution[0])
    return Estimate(value, max(value - reach, 0.0), value + reach), solution


def background_figures(background: LocalBackground, pixels: int) -> tuple[float, float, float]:
    """Return level [DN], variance [DN^2] and its standard deviation of one image's background without targets.

    ``pixels``: of the image.
    """
    cells = background.variance[::2, ::2]  # two levels each way for a cell of the noise
    variance = float(np.median(cells))
    spread = 1.4826 * float(np.median(np.abs(cells - variance)))
    by_cells = spread * math.sqrt(FILTERED_CELLS / cells.size)
    by_pairs = variance * math.sqrt(2.0 * STRIDE_PX**2 / pixels)
    return float(np.median(background.level)), variance, math.sqrt(MEDIAN_LOSS) * max(by_cells, by_pairs)


def noise_estimate(measured: Sequence[tuple[float, float]]) -> Estimate | None:
    """Return the noise [DN] less rounding from variances [DN^2] and their standard deviations.

    None without any; where the noise is not measurable, the interval from 0 to the least measurable noise.
    """
    if not measured:
        return None
    variances, sigmas = np.array(measured).T
    weights = 1.0 / sigmas**2
    mean = float(weights @ variances / weights.sum())
    sigma = float(weights.sum() ** -0.5)
    if len(measured) > 1:
        # the ratio of Birge: measurements that differ by more than their own errors
        sigma *= max(1.0, math.sqrt(float(weights @ (variances - mean) ** 2) / (len(measured) - 1)))
    reach = norm.ppf(0.5 + 0.5 * CONFIDENCE) * sigma
    if mean < LEAST_NOISE_DN**2 + ROUNDING_DN2:
        return Estimate(LEAST_NOISE_DN, 0.0, LEAST_NOISE_DN)
    low, value, high = (math.sqrt(max(v - ROUNDING_DN2, 0.0)) for v in (mean - reach, mean, mean + reach))
    return Estimate(value, low, high)


def sensor_line(one: LearnedSensor) -> str:
    """Return in words what a camera's images tell of its sensor."""
    if one.noise_dn is None:
        noise = "noise not measured"
    elif one.noise_measurable:
        noise = f"noise {_in_words(one.noise_dn, 'DN')}"
    else:
        noise = f"noise below {one.noise_dn.high:g} DN, hidden by rounding"
    gain = "gain not learned" if one.gain_dn_per_e is None else f"gain {_in_words(one.gain_dn_per_e, 'DN/e-')}"
    blur = "" if one.blur_px is None else f", blur {_in_words(one.blur_px, 'px')}"
    steps = "" if one.step_dn == 1 else f" in steps of {one.step_dn} DN"
    if one.saturation_dn is None:
        most = f"largest value {one.largest_dn} DN, not saturated"
    else:
        most = f"saturation at {one.saturation_dn} DN reached by {100 * one.saturated:.3g} % of targets"
    return (
        f"camera '{one.name}': {noise}, {gain}{blur}, {one.bits} bits{steps}, {most}; learned from {one.images} "
        f"images, {one.targets} targets"
    )


def _in_words(estimate: Estimate, unit: str) -> str:
    return f"{estimate.value:.3g} {unit} ({estimate.low:.3g} to {estimate.high:.3g})"


def left_out_line(one: LearnedSensor, settings: DetectionSettings, shape: tuple[int, int]) -> str:
    """Return in words how many targets were left out of how many, and why, '' where that is not notable.

    ``shape``: (H, W) of the camera's images. Targets cut by the border count as far as they exceed the number
    expected from targets all over the image. The others must exceed what noise alone makes.
    """
    left_out = {reason: n for reason, n in one.left_out.items() if n}
    seen = one.found + sum(left_out.values())
    by_noise = poisson.isf(BY_CHANCE, settings.false_alarms * one.images)
    others = sum(n for reason, n in left_out.items() if reason != "cut")
    # a target of the largest size allowed touches the border in this share of its places
    cut = left_out.get("cut", 0) - seen * settings.maximum_size_px * (1.0 / shape[0] + 1.0 / shape[1])
    if others <= by_noise or others + max(cut, 0.0) <= NOTABLE * seen:
        return ""
    sigmas = peak_sigmas(settings.false_alarms, shape[0] * shape[1])
    words = {
        "faint": f"below {sigmas:.1f} standard deviations of the noise",
        "small": f"not longer than detection.minimum_size_px ({settings.minimum_size_px:g})",
        "large": f"not shorter than detection.maximum_size_px ({settings.maximum_size_px:g})",
        "uneven": "no brighter than what surrounds them",
        "cut": "cut by the image's border",
    }
    reasons = sorted(left_out, key=lambda reason: -left_out[reason])
    n = one.images
    return (
        f"camera '{one.name}': {_rounded(one.found / n)} of about {_rounded(seen / n)} bright spots an image are "
        f"targets; left out: {', '.join(f'{_rounded(left_out[reason] / n)} {words[reason]}' for reason in reasons)}"
    )


def _rounded(number: float) -> str:
    """Return a number with about two digits, all of its whole ones."""
    return f"{number:.0f}" if number >= 10 else f"{number:.2g}"
