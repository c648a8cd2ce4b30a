"""Focus and aperture of a lens from the blur of targets at known depths.

The blur circle of a thin lens is linear in the inverse depth u = 1 / d: its diameter is ``|c|`` with
``c = -s (u - 1 / F)`` [px], where F is the distance of focus, ``s = a F / (F - f)``, f the focal length and
``a = f^2 / N / pitch`` with the f-number N (``twin.cameras.optics.psf``). An even disc of diameter c has the rms
c / 4 an axis, so the squared blur of a target is ``psf^2 + c^2 / 16``. ``psf``, and c at the targets' mean u and its
slope, are estimated by least squares.
"""

import math
from dataclasses import dataclass

import numpy as np

from mosca.accuracy.lab_twin.estimates import SPREAD
from mosca.data.arrays import Array

FEWEST = 6
"""Fewest targets at known depths."""
LEAST_SIGNIFICANCE = 4.0
"""Least ratio of an estimate to its standard deviation: the slope, the focus' inverse distance, the squared blur in
focus. Of ten targets, 4 or more has a probability of 0.5 % by chance (Student's t, 7 degrees of freedom)."""
LEAST_PSF_PX = 0.1
"""Blur in focus where the targets show none: the least that a scenario may state."""


@dataclass(frozen=True, eq=False)
class Defocus:
    """Blur over depth: ``psf_px`` in focus, and the focus' inverse distance ``focus_per_m`` and ``slope_px_m``."""

    psf_px: float
    focus_per_m: float
    """1 / F [1/m]; below 0: beyond infinity."""
    slope_px_m: float
    """s, above 0 [px m]."""
    covariance: Array
    """(3, 3) of the three; 0 in the row and column of a blur in focus that is LEAST_PSF_PX for want of evidence."""
    targets: int
    scatter_px: float
    """Rms of the targets' blurs about the model."""

    def circle_px(self, depth_m: Array) -> Array:
        """Return the diameters of the blur circles at depths [px]."""
        return np.abs(self.slope_px_m * (1.0 / depth_m - self.focus_per_m))

    def share(self, depth_m: Array, shake_px: float) -> Array:
        """Return the share of defocus in the squared blur at depths, with ``shake_px`` in the mean image."""
        disc = self.circle_px(depth_m) ** 2 / 16.0
        return np.asarray(disc / (disc + self.psf_px**2 + shake_px**2))

    @property
    def is_told(self) -> bool:
        """Whether slope and focus are significant."""
        sigma = np.sqrt(np.diag(self.covariance))
        return bool(
            self.slope_px_m > LEAST_SIGNIFICANCE * sigma[2] and self.focus_per_m > LEAST_SIGNIFICANCE * sigma[1]
        )

    def lens(self, focal_m: float, pitch_m: float) -> tuple[Array, Array]:
        """Return (blur in focus [px], focus [m], f-number) of a lens with this pixel pitch, and their covariance."""
        focus, rest = 1.0 / self.focus_per_m, 1.0 - focal_m * self.focus_per_m
        number = focal_m**2 / pitch_m / (self.slope_px_m * rest)
        by = np.array(
            [[1.0, 0.0, 0.0], [0.0, -(focus**2), 0.0], [0.0, number * focal_m / rest, -number / self.slope_px_m]]
        )
        return np.array([self.psf_px, focus, number]), by @ self.covariance @ by.T


def defocus_of(depth_m: Array, blur_px: Array) -> Defocus | None:
    """Return the blur over depth from the blurs (n,) of targets at depths (n,); None for fewer than FEWEST.

    A target farther off the first fit than 4 standard deviations, by the median of all, is left out.
    """
    keep = np.ones(len(depth_m), bool)
    found = None
    for _ in range(2):
        if keep.sum() < FEWEST:
            return None
        found = _fit(1.0 / depth_m[keep], blur_px[keep])
        off = np.abs(np.hypot(found.psf_px, found.circle_px(depth_m) / 4.0) - blur_px)
        keep = off <= 4.0 * SPREAD * np.median(off) + 1e-9
    return found


def _fit(u: Array, blur: Array) -> Defocus:
    """Return the fit of blurs at inverse depths ``u``; the blur in focus is fixed where it is not significant."""
    free = _solved(u, blur, None)
    square, sigma = free[0][2], math.sqrt(free[1][2, 2])
    least = LEAST_PSF_PX**2
    found, covariance, scatter = free if square > least + LEAST_SIGNIFICANCE * sigma else _solved(u, blur, least)
    middle, slope, square = found
    psf = math.sqrt(square)
    # to (psf, 1 / F, s)
    turn = np.array([[0.0, 0.0, 0.5 / psf], [-1.0 / slope, middle / slope**2, 0.0], [0.0, 1.0, 0.0]])
    focus = float(u.mean()) - middle / slope
    if slope < 0.0:
        turn[2] *= -1.0
    return Defocus(psf, focus, abs(slope), turn @ covariance @ turn.T, len(u), scatter)


def _solved(u: Array, blur: Array, square: float | None) -> tuple[Array, Array, float]:
    """Return (c at the mean of u, slope, psf^2), covariance and rms scatter; ``square``: psf^2 if it is fixed."""
    from scipy.optimize import least_squares  # takes long to import; most commands that read a lab do not fit one

    at = u - u.mean()
    n = 2 if square is not None else 3

    def model(p: Array) -> tuple[Array, Array]:
        c = p[0] + p[1] * at
        own = p[2] if square is None else square
        made = np.sqrt(np.maximum(c**2 / 16.0 + own, 1e-12))
        slopes = np.stack([c / 16.0, c * at / 16.0, np.full_like(at, 0.5)], axis=1)[:, :n] / made[:, None]
        return made, slopes

    mean = 4.0 * float(np.sqrt(np.mean(blur**2)))
    tilt = float(np.polyfit(at, 4.0 * blur, 1)[0]) or 1.0
    # focus beyond or before all targets, or among them
    starts = [[mean, tilt], [0.0, 2.0 * mean / max(float(np.abs(at).max()), 1e-6)]]
    low = [-np.inf, -np.inf, 0.0][:n]
    best = min(
        (
            least_squares(
                lambda p: model(p)[0] - blur,
                [*one, 0.25 * float(blur.min()) ** 2 + 1e-6][:n],
                lambda p: model(p)[1],
                bounds=(low, np.full(n, np.inf)),
                x_scale="jac",
            )
            for one in starts
        ),
        key=lambda one: float(one.cost),
    )
    variance = 2.0 * float(best.cost) / (len(u) - n)
    covariance = np.zeros((3, 3))
    covariance[:n, :n] = variance * np.linalg.pinv(best.jac.T @ best.jac)
    p = np.append(best.x, square) if square is not None else best.x
    return p, covariance, math.sqrt(variance)
