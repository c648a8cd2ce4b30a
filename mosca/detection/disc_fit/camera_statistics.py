"""Sub-pixel refinement of detected targets, and the estimates of each camera's blur and bias that it uses.

The model is a disc of radius R and brightness A on a background b, under a blur s of lens and pixel together. Its
edge at the distance r from the centre (x, y) is

    I(r) = b + A / 2 erfc((r - R) / (s sqrt 2))

This is the straight edge under a Gaussian blur, bent to a circle; for a target that is small beside the blur it
becomes a bell. Elliptic targets are first mapped to round ones by their second moments. The fit is maximum likelihood
with the noise of EMVA 1288, ``var(I) = dark + gain (I - b)``, by Gauss-Newton steps for x, y, A, b, R and s. The
normal matrix gives the covariance. Where the residuals are significantly larger than usual with this camera (targets
that are hidden in part, images that are no discs), the covariance is scaled by the ratio of their chi-squares. For a
window that is symmetric about the target, the centre is uncorrelated with the other four unknowns, so they do not add
to its variance. The blur has a prior from earlier frames, since radius and blur of a target of 2 px are nearly
collinear. Saturated pixels and those of neighbours are left out. Where the blur is small beside a pixel, pixels are
divided into parts (``mosca.detection.disc_fit.disc_image``), all unknowns are solved for together, and the shape of
elliptic targets follows from the residuals (``mosca.detection.disc_fit.ellipse``). A disc that moved while exposed is
taken where it leaves smaller residuals than an ellipse (``mosca.detection.disc_fit.smear``).

No point spread function is given. The following is estimated from the frames, camera by camera
(``CameraStatistics``):

- the blur, as the mean over clean targets of the estimates from their own pixels, weighted by their information;
- ln amplitude as a line over ln flux, with the spread of targets about it: the prior of targets whose few pixels do
  not distinguish a small bright target from a large dim one;
- how its targets differ from evenly bright discs, and their edges from Gaussian ones
  (``mosca.detection.disc_fit.profile``);
- how far the fit lies from the *light's centroid*, as a smooth function of the position in the image and of the
  target's size. Centroids add under convolution, so the light's centroid is the target's own plus that of the lens'
  point spread function, whatever the target's size. Calibration takes this displacement for distortion. A fit of a
  symmetric edge to an asymmetric image (coma) lies elsewhere, by an amount that depends on the target's size.
  ``(1, 1/R, 1/R^2, R) x (1, u, v)`` is fitted to centroid less fit; all terms but those in R are added to the fitted
  centre. Those in R are not: a brightness gradient g across the target shifts its centroid by ``g R / 4``,
  proportional to R, without shifting its centre. The two are separable only where a camera sees targets of several
  sizes with the same shading; otherwise the centre is that of the fit, or the light's centroid.

The offsets are used from ``ENOUGH`` centroids on, where they are statistically significant (``CHANCE``).
"""

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.gauss_newton import LEAST_BLUR, MOST_BLUR
from mosca.detection.disc_fit.hidden_background import RIM_SIGMAS, RIMS
from mosca.detection.disc_fit.light_offset import (
    AMPLITUDE_SUMS,
    BLUR_SUM,
    BLUR_WEIGHT,
    N_LIGHT,
    N_TARGETS,
    N_TERMS,
    PROFILE_SUMS,
    RIM_SUMS,
    ROUGH_SUM,
    SMEARED_SUM,
    TRIED_SUM,
    StatisticsSums,
    no_sums,
)
from mosca.detection.disc_fit.priors import AMPLITUDE_SIGMA_2, Priors
from mosca.detection.disc_fit.profile import solve_profiles, weights_of_older
from mosca.detection.disc_fit.row import FIRST_ROUGHNESS
from mosca.detection.local_background import LocalBackground

T = TypeVar("T")

FIRST_BLUR_PX, FIRST_SPREAD = 0.75, 0.5
"""Blur assumed of a camera without statistics, and its standard deviation as a share of it."""
SPREAD = 0.15
"""Standard deviation of a target's blur about that of its camera (depth of field), as a share of it."""
FEW, ENOUGH, MEMORY = 3.0, 400.0, 20_000.0
"""Number of targets from which the blur is used, which is also the weight of the first guess of the misfit; number of
centroids from which offsets are used; number of targets after which older ones are weighted down."""
LEAST_AMPLITUDE_SPREAD = 0.05
"""Least standard deviation that is assumed for the amplitude of a camera's targets, as a share."""
SLOPE_MEAN, SLOPE_SIGMA = 0.25, 0.25
"""Mean and standard deviation of the slope of ln amplitude over ln flux, before any target is seen."""
CHANCE = 12.0
"""Least chi-square of a term of the offset, per axis: false-positive rate below 1 / 2,000."""


@dataclass(frozen=True, eq=False)
class CameraStatistics:
    """Statistics of some cameras from earlier frames; read-only, added up with ``plus``."""

    names: tuple[str, ...] = ()
    """Cameras (n)."""
    sums: StatisticsSums = field(default_factory=lambda: no_sums(0))
    """Sums (n) over fitted targets, from which blur, bias and gain are estimated."""
    backgrounds: Mapping[str, LocalBackground] = field(default_factory=dict)
    """Backgrounds that were measured, by camera."""
    _kept: dict[Hashable, Any] = field(default_factory=dict, repr=False)
    """Values computed from these statistics, by what they depend on besides."""
    _parts: Mapping[str, "CameraStatistics"] = field(default_factory=dict, repr=False)

    def plus(self, other: "CameraStatistics") -> "CameraStatistics":
        """Return the sum of both. Beyond MEMORY targets of a camera the older ones are weighted down."""
        if self.names != other.names:
            names = self.names + tuple(name for name in other.names if name not in self.names)
            return self._of(names).plus(other._of(names)) if self.names else other
        kept = self.sums
        if max(kept.tallies[:, N_TARGETS].tolist(), default=0.0) > MEMORY:
            keep = np.minimum(1.0, MEMORY / np.maximum(kept.tallies[:, N_TARGETS], 1.0))
            kept = StatisticsSums(*(keep.reshape(-1, *[1] * (part.ndim - 1)) * part for part in kept))
        kept = _less_profile(kept, other.sums)
        backgrounds = self.backgrounds
        if other.backgrounds:
            later = other.backgrounds
            measured = {name: own.plus(later.get(name)) for name, own in backgrounds.items()}
            backgrounds = {**later, **measured}
        return CameraStatistics(
            self.names, StatisticsSums(*(a + b for a, b in zip(kept, other.sums, strict=True))), backgrounds
        )

    def kept(self, key: Hashable, made: Callable[[], T]) -> T:
        """Return what was computed from these statistics under this key, computed once by ``made``."""
        if key not in self._kept:
            self._kept[key] = made()
        result: T = self._kept[key]
        return result

    def of(self, name: str) -> "CameraStatistics":
        """Return one camera's own statistics, with what was computed from them before."""
        return self._parts.get(name, self)

    def blur_px(self, name: str) -> float:
        """Return the blur [px] of a camera, standard deviation of its edges; ``FIRST_BLUR_PX`` without statistics."""
        return float(self.priors((name,)).blurs[0, 0])

    def priors(self, names: tuple[str, ...]) -> Priors:
        """Return what the fit of these cameras starts from."""
        return self.kept(names, lambda: self._made_priors(names))

    def _made_priors(self, names: tuple[str, ...]) -> Priors:
        parts = [self._parts[name] for name in names if name in self._parts]
        if len(parts) == len(names) > 0:
            each = [one.priors(one.names) for one in parts]
            return Priors(*(np.concatenate(column) for column in zip(*each, strict=True)))
        return _priors(self if names == self.names else self._of(names))

    def solve(self) -> None:
        """Compute the priors of these cameras' fits ahead of the first fit, which would wait for them otherwise."""
        for name in self.names:
            one = self._parts.get(name, self)
            one.priors(one.names)

    def by_camera(self) -> dict[str, "CameraStatistics"]:
        """Return each camera's own statistics."""
        return {name: self._one(k) for k, name in enumerate(self.names)}

    def _one(self, k: int) -> "CameraStatistics":
        """Return the statistics of camera k alone."""
        name = self.names[k]
        own = {name: self.backgrounds[name]} if name in self.backgrounds else {}
        return CameraStatistics((name,), StatisticsSums(*(part[k : k + 1] for part in self.sums)), own)

    def backgrounds_alone(self) -> "CameraStatistics":
        """Return only the backgrounds of these statistics, with their cameras."""
        return CameraStatistics(tuple(self.backgrounds), no_sums(len(self.backgrounds)), self.backgrounds)

    def targets(self) -> float:
        """Return how many targets they hold."""
        return float(self.sums.tallies[:, N_TARGETS].sum())

    def _of(self, names: tuple[str, ...]) -> "CameraStatistics":
        """Return the same for other cameras, zeros for those without any."""
        rows = np.array([self.names.index(name) if name in self.names else -1 for name in names])
        nothing = no_sums(1)
        parts = [np.concatenate(pair)[rows] for pair in zip(self.sums, nothing, strict=True)]
        backgrounds = {name: self.backgrounds[name] for name in names if name in self.backgrounds}
        return CameraStatistics(names, StatisticsSums(*parts), backgrounds)


NO_STATISTICS = CameraStatistics()


def _less_profile(sums: StatisticsSums, added: StatisticsSums) -> StatisticsSums:
    """Return sums with those of profiles weighted down by ``weights_of_older``."""
    profiles = slice(PROFILE_SUMS, TRIED_SUM)
    if not any(added.tallies[:, PROFILE_SUMS].tolist()):
        return sums
    weights = weights_of_older(sums.tallies[:, profiles], added.tallies[:, profiles])
    if (weights == 1.0).all():
        return sums
    tallies = sums.tallies.copy()
    tallies[:, profiles] *= weights[:, None]
    return sums._replace(tallies=tallies)


def summed(camera: str, parts: Iterable[CameraStatistics]) -> CameraStatistics:
    """Return the sum of what ``parts`` hold of one camera: of sets so near each other that none counts as older."""
    own = [(part, part.names.index(camera)) for part in parts if camera in part.names]
    if not own:
        return NO_STATISTICS
    columns = zip(*([part[k] for part in one.sums] for one, k in own), strict=True)
    sums = StatisticsSums(*(np.sum(column, axis=0)[None] for column in columns))
    background: LocalBackground | None = None
    for one, _ in own:
        later = one.backgrounds.get(camera)
        background = later if background is None else background.plus(later)
    return CameraStatistics((camera,), sums, {} if background is None else {camera: background})


def joined(parts: Mapping[str, CameraStatistics]) -> CameraStatistics:
    """Return the statistics of single cameras as one; the priors of their fits are not computed again."""
    known = {name: one for name, one in parts.items() if one.names}
    if not known:
        return NO_STATISTICS
    columns = zip(*(one.sums for one in known.values()), strict=True)
    return CameraStatistics(
        tuple(known),
        StatisticsSums(*(np.concatenate(column) for column in columns)),
        {name: background for one in known.values() for name, background in one.backgrounds.items()},
        _parts=known,
    )


def _priors(statistics: CameraStatistics) -> Priors:
    tallies, normal, right_side = statistics.sums
    known = tallies[:, BLUR_WEIGHT] > 0
    weight = np.where(known, tallies[:, BLUR_WEIGHT], 1.0)
    mean = np.where(known, tallies[:, BLUR_SUM] / weight, FIRST_BLUR_PX)
    profiles, blurs = solve_profiles(tallies[:, PROFILE_SUMS:TRIED_SUM], mean)
    mean, blurs = np.clip(mean, LEAST_BLUR, MOST_BLUR), np.clip(blurs, LEAST_BLUR, MOST_BLUR)
    surely = known & (tallies[:, N_TARGETS] >= FEW)
    spread = np.sqrt((np.where(surely, SPREAD, FIRST_SPREAD) * mean) ** 2 + np.where(known, 1 / weight, 0.0))
    usual = (tallies[:, ROUGH_SUM] + FEW * FIRST_ROUGHNESS) / (tallies[:, N_TARGETS] + FEW)
    offsets = np.zeros((len(tallies), N_TERMS, 2))
    enough = np.flatnonzero(tallies[:, N_LIGHT] >= ENOUGH)
    if len(enough):
        offsets[enough] = _offsets(normal[enough], right_side[enough])
    amplitudes, rims = _amplitudes(tallies[:, AMPLITUDE_SUMS:RIM_SUMS]), _rims(tallies[:, RIM_SUMS:PROFILE_SUMS])
    smeared = (tallies[:, SMEARED_SUM] + 1) / (tallies[:, TRIED_SUM] + 1)
    return Priors(np.column_stack([mean, spread, blurs]), offsets, usual, amplitudes, rims, profiles, smeared)


def _rims(sums: Array) -> Array:
    """Return the ratios (n,) at which parabolas through sums of chi-square (n, 5) are least; 1 if they may be 1."""
    ratios, out = np.array(RIMS), np.ones(len(sums))
    for k in np.flatnonzero(np.ptp(sums, axis=1) > 0):
        middle = np.clip(sums[k].argmin(), 1, len(ratios) - 2)
        at = slice(middle - 1, middle + 2)
        bend, slope, _ = np.polyfit(ratios[at] - ratios[middle], sums[k, at], 2)
        least = ratios[middle] - 0.5 * slope / bend if bend > 0 else 1.0
        if least > 1.0 and (least - 1.0) ** 2 * bend > RIM_SIGMAS**2:
            out[k] = min(least, ratios[-1])
    return out


def _amplitudes(sums: Array) -> Array:
    """Return the lines (n, 5) of ``Priors.amplitudes`` from their sums (n, 7)."""
    known = sums[:, 0] * AMPLITUDE_SIGMA_2 >= FEW
    w, *rest = sums.T
    f, ff, log, fl, ll, v = (part / np.where(known, w, 1.0) for part in rest)
    ff, fl, ll = ff - f * f, fl - f * log, ll - log * log
    # targets of one brightness have the slope 0, those of one size at different distances 1/2
    n = np.maximum(w * AMPLITUDE_SIGMA_2, 1.0)
    ridge = np.maximum(ll - v, LEAST_AMPLITUDE_SPREAD**2) / (n * SLOPE_SIGMA**2)
    slope = (fl + ridge * SLOPE_MEAN) / (ff + ridge)
    variance = np.maximum(ll - 2 * slope * fl + slope**2 * ff - v, LEAST_AMPLITUDE_SPREAD**2)
    about = np.where(known, variance * (1 + 1 / n), np.inf)
    return np.column_stack([f, log, slope, about, np.where(known, variance / n / (ff + ridge), 0.0)])


def _offsets(normal: Array, right_side: Array) -> Array:
    """Return for n cameras the significant terms (n, 12, 2) of the offset, 0 for the others.

    For each axis, the allowed set of terms is taken whose chi-square, less CHANCE a term, is largest. Terms in R and
    (1, 1/R, 1/R^2) are so strongly correlated that superfluous ones only add noise.
    """
    out = np.zeros(right_side.shape)
    best = np.zeros((len(out), 2))
    for allowed, ridge in _TERM_SETS:
        part = normal[:, allowed[:, None], allowed] + ridge
        pulls = right_side[:, allowed]
        terms = np.linalg.solve(part, pulls)
        score = (terms * pulls).sum(axis=1) - CHANCE * len(allowed)
        better = score > best
        if better.any():
            best = np.maximum(score, best)
            out *= ~better[:, None]
            out[:, allowed] += better[:, None] * terms
    return out


# A ridge [px^-2] that acts only on combinations which the observed sizes and positions leave undetermined: these are
# assigned to the terms without R.
_RIDGE = 1 / np.where(np.arange(N_TERMS) < 9, 0.3, 0.1) ** 2
_TERM_SETS = [
    (np.array(terms), np.diag(_RIDGE[terms]))
    for terms in ([0], [0, 3, 6], [0, 1, 2, 3, 4, 5, 6, 7, 8], [0, 3, 6, 9], list(range(N_TERMS)))
]
