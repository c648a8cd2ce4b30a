"""Sub-pixel refinement of detected targets, and what it learns from the frames.

The model: a disc of radius R and brightness A on a background b, seen through a blur s that holds lens and pixel
together, whose edge at the distance r from the place (x, y) is

    I(r) = b + A / 2 erfc((r - R) / (s sqrt 2))

the straight edge under a Gaussian blur, bent round; where the target is small beside the blur it goes over into
a bell. Elliptic targets are made round first, by their second moments. Maximum likelihood with the pixel noise of
EMVA 1288, ``var(I) = read^2 + gain (I - b) + 1/12``, by Gauss-Newton steps for x, y, A, b, R and s, whose normal
matrix gives the covariance. The place is at right angles to the other four for a window that is symmetric about
the target, so that they cost it nothing. The blur has a prior from the frames before, without which a target of
2 px could be a small one of much blur or a large one of little. Pixels that are saturated, or that a neighbour
lights up, are left out.

No point spread function is given. What the frames teach, camera by camera (``CameraStatistics``):

- the blur, as the mean over clean targets of what their own pixels say of it, weighted by their information;
- how far the fit lies from the *light's centroid*, as a smooth function of the place in the image and of the
  target's size. Centroids add under convolution, so the light's centroid is the target's own plus that of the
  lens' point spread function, whatever the target's size: a displacement that calibration takes for
  distortion. A fit of a symmetric edge to an asymmetric image (coma) lies elsewhere, by an amount that depends on
  the target's size. ``(1, 1/R, 1/R^2, R) x (1, u, v)`` is fitted to centroid less fit; all terms but those in R
  are put onto the fit. Those in R are not: a brightness that falls across the target draws its centroid off by
  ``g R / 4``, proportional to R, and is no displacement of its middle. The two are told apart by the sizes that
  a camera sees; where all are of one size, and where shading differs from target to target, they are not, and the
  place is that of the fit, or of the light's centroid.

The offsets are used once they are certain: from ``ENOUGH`` centroids on, and where chance does not explain them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mosca.data.arrays import Array
from mosca.detection.disc_fit.fit_regions import (
    BLUR_SUM,
    BLUR_WEIGHT,
    N_LIGHT,
    N_TALLIES,
    N_TARGETS,
    N_TERMS,
    ROUGH_SUM,
)

FIRST_BLUR_PX, FIRST_SPREAD = 0.75, 0.5
"""Blur assumed of a camera that has shown nothing yet, and its standard deviation as a share of it."""
SPREAD = 0.15
"""Standard deviation of a target's blur about that of its camera (depth of field), as a share of it."""
USUAL_ROUGHNESS = 4e-4
"""Misfit beyond the noise of a camera that has shown nothing yet, over the squared amplitude: (2 %)^2."""
FEW, ENOUGH, MEMORY = 3.0, 400.0, 20_000.0
"""Clean targets from which the blur is taken over; centroids from which offsets are; targets after which the
oldest are forgotten."""
CHANCE = 12.0
"""Chi-square that a term of the offset must bring, an axis; what chance does not give in 2,000 tries."""


@dataclass(frozen=True, eq=False)
class CameraStatistics:
    """What the frames of some cameras have taught; read-only, and added up with ``plus``.

    For each camera ``names``: ``tallies`` (n, 5) number of clean targets, sums for the blur, of misfits, number
    of centroids; ``normal`` (n, 12, 12) and ``right_side`` (n, 12, 2) of the offsets' least squares.
    """

    names: tuple[str, ...] = ()
    tallies: Array = field(default_factory=lambda: np.zeros((0, N_TALLIES)))
    normal: Array = field(default_factory=lambda: np.zeros((0, N_TERMS, N_TERMS)))
    right_side: Array = field(default_factory=lambda: np.zeros((0, N_TERMS, 2)))
    _priors: dict[tuple[str, ...], "Priors"] = field(default_factory=dict, repr=False)
    _parts: Mapping[str, "CameraStatistics"] = field(default_factory=dict, repr=False)

    def plus(self, other: "CameraStatistics") -> "CameraStatistics":
        """Return what both teach together. Beyond MEMORY targets of a camera the older ones fade."""
        if self.names != other.names:
            names = self.names + tuple(name for name in other.names if name not in self.names)
            return self._of(names).plus(other._of(names)) if self.names else other
        if max(self.tallies[:, N_TARGETS].tolist(), default=0.0) <= MEMORY:
            return CameraStatistics(
                self.names,
                self.tallies + other.tallies,
                self.normal + other.normal,
                self.right_side + other.right_side,
            )
        keep = np.minimum(1.0, MEMORY / np.maximum(self.tallies[:, N_TARGETS], 1.0))
        return CameraStatistics(
            self.names,
            keep[:, None] * self.tallies + other.tallies,
            keep[:, None, None] * self.normal + other.normal,
            keep[:, None, None] * self.right_side + other.right_side,
        )

    def blur_px(self, name: str) -> float:
        """Return the blur [px] of a camera, standard deviation of its edges; that assumed where none is learned."""
        return float(self.priors((name,)).blurs[0, 0])

    def priors(self, names: tuple[str, ...]) -> "Priors":
        """Return what the fit of these cameras starts from."""
        if names not in self._priors:
            parts = [self._parts[name] for name in names if name in self._parts]
            if len(parts) == len(names) > 0:
                self._priors[names] = _stacked([one.priors(one.names) for one in parts])
            else:
                self._priors[names] = _priors(self if names == self.names else self._of(names))
        return self._priors[names]

    def conclude(self) -> None:
        """Work out what the fits of these cameras start from, which else the first fit waits for."""
        for name in self.names:
            one = self._parts.get(name, self)
            one.priors(one.names)

    def each(self) -> dict[str, "CameraStatistics"]:
        """Return what each camera has taught by itself."""
        return {
            name: CameraStatistics(
                (name,), self.tallies[k : k + 1], self.normal[k : k + 1], self.right_side[k : k + 1]
            )
            for k, name in enumerate(self.names)
        }

    def _of(self, names: tuple[str, ...]) -> "CameraStatistics":
        """Return the same for other cameras, zeros for those that are not known."""
        rows = np.array([self.names.index(name) if name in self.names else -1 for name in names])
        parts = []
        for part in (self.tallies, self.normal, self.right_side):
            padded = np.concatenate([part, np.zeros((1, *part.shape[1:]))])
            parts.append(padded[rows])
        return CameraStatistics(names, *parts)


NO_STATISTICS = CameraStatistics()


def joined(parts: Mapping[str, CameraStatistics]) -> CameraStatistics:
    """Return what single cameras have taught as one; what their fits start from is not worked out again."""
    known = {name: one for name, one in parts.items() if one.names}
    if not known:
        return NO_STATISTICS
    return CameraStatistics(
        tuple(known),
        np.concatenate([one.tallies for one in known.values()]),
        np.concatenate([one.normal for one in known.values()]),
        np.concatenate([one.right_side for one in known.values()]),
        _parts=known,
    )


@dataclass(frozen=True, eq=False)
class Priors:
    """What the fit of n images starts from: ``blurs`` (n, 2) mean and standard deviation [px], ``offsets`` (n, 12, 2)
    [px] of the place, ``roughness`` (n,) usual misfit.
    """

    blurs: Array
    offsets: Array
    roughness: Array


def _stacked(ones: Sequence[Priors]) -> Priors:
    return Priors(
        np.concatenate([one.blurs for one in ones]),
        np.concatenate([one.offsets for one in ones]),
        np.concatenate([one.roughness for one in ones]),
    )


def _priors(learned: CameraStatistics) -> Priors:
    tallies = learned.tallies
    known = tallies[:, BLUR_WEIGHT] > 0
    weight = np.where(known, tallies[:, BLUR_WEIGHT], 1.0)
    mean = np.where(known, tallies[:, BLUR_SUM] / weight, FIRST_BLUR_PX)
    mean = np.clip(mean, 0.3, 6.0)
    surely = known & (tallies[:, N_TARGETS] >= FEW)
    spread = np.sqrt((np.where(surely, SPREAD, FIRST_SPREAD) * mean) ** 2 + np.where(known, 1 / weight, 0.0))
    usual = np.where(
        tallies[:, N_TARGETS] > 0, tallies[:, ROUGH_SUM] / np.maximum(tallies[:, N_TARGETS], 1.0), 0.0
    )
    offsets = np.zeros((len(tallies), N_TERMS, 2))
    enough = np.flatnonzero(tallies[:, N_LIGHT] >= ENOUGH)
    if len(enough):
        offsets[enough] = _offsets(learned.normal[enough], learned.right_side[enough])
    return Priors(np.column_stack([mean, spread]), offsets, np.maximum(usual, USUAL_ROUGHNESS))


def _offsets(normal: Array, right_side: Array) -> Array:
    """Return for n cameras the terms (n, 12, 2) of the offset that chance does not explain, 0 otherwise.

    Of the sets of terms allowed the one whose chi-square, less CHANCE a term, is largest, axis by axis: terms in R
    and (1, 1/R, 1/R^2) are so much alike that needless ones would only bring noise.
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


# A ridge [px^-2] that only the directions feel which the sizes and places seen leave open: what may be either goes
# to the terms without R.
_RIDGE = 1 / np.where(np.arange(N_TERMS) < 9, 0.3, 0.1) ** 2
_TERM_SETS = [
    (np.array(terms), np.diag(_RIDGE[terms]))
    for terms in ([0], [0, 3, 6], [0, 1, 2, 3, 4, 5, 6, 7, 8], [0, 3, 6, 9], list(range(N_TERMS)))
]
