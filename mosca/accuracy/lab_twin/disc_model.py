"""The image of an evenly bright ellipse through a Gaussian blur, each pixel the mean over its square, exactly.

In the frequency domain the ellipse is ``2 J1(x) / x`` with ``x = 2 pi |E f|`` (E: the symmetric matrix of its
semi-axes), the blur is ``exp(-2 pi^2 sigma^2 |f|^2)``, and the pixel is ``sinc(fx) sinc(fy)``. The image is the
Fourier series of the product, over a period that leaves room around the window.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.special import j0, j1

from mosca.data.arrays import Array

ROOM_PX = 12
"""Length added to a window's side for the period: more than the reach of the blur of the next copy in the series."""
HIGHEST = 1.3
"""Highest frequency of the series [1/px]: at a blur of 0.4 px the Gaussian has fallen to 0.5 %, a disc to less."""
LEAST_BLUR_PX, MOST_BLUR_PX = 0.2, 4.0
"""Range of blurs in a fit: a fit that ends at either bound is rejected."""


@dataclass(frozen=True)
class EllipseFit:
    """An ellipse fitted to an image; positions from the window's first pixel."""

    level: float
    """Brightness of the ellipse above ``background``."""
    background: float
    x_px: float
    y_px: float
    axes: tuple[float, float, float]
    """xx, yy, xy of the matrix of semi-axes [px]."""
    blur_px: float
    misfit: float
    """Rms of the residuals over ``level``."""
    defocus: float = 0.0
    """Share of ``blur_px`` squared that is defocus, an even disc; the rest is Gaussian."""

    @property
    def radius_px(self) -> float:
        """Mean radius."""
        xx, yy, xy = self.axes
        return math.sqrt(abs(xx * yy - xy * xy))


class DiscModel:
    """Images of ellipses in windows of one size."""

    def __init__(self, size: int) -> None:
        """``size``: side of the square window [px]."""
        period = size + ROOM_PX
        half = math.ceil(HIGHEST * period)
        self._fx, self._fy = np.arange(0, half + 1) / period, np.arange(-half, half + 1) / period
        self._pixel = np.sinc(self._fx)[None, :] * np.sinc(self._fy)[:, None]
        # the series is real: the half plane of positive fx counts twice
        self._twice = np.where(np.arange(half + 1) > 0, 2.0, 1.0)[None, :]
        self._square = self._fx[None, :] ** 2 + self._fy[:, None] ** 2
        self._period, self._at = period, np.arange(size)

    def unit(self, x: float, y: float, axes: tuple[float, float, float], blur_px: float) -> Array:
        """Return the image (size, size) of an ellipse of brightness 1 at (x, y) on a dark background."""
        return self._image(x, y, self._parts(axes, blur_px, 0.0)[0])

    def with_slopes(self, fit: EllipseFit, blur_px: float) -> tuple[Array, Array, Array]:
        """Return the fitted ellipse's image at brightness 1 with another blur, and its derivatives by x and y."""
        spectrum = self._parts(fit.axes, blur_px, fit.defocus)[0]
        down_x = -2j * np.pi * self._fx[None, :] * spectrum
        down_y = -2j * np.pi * self._fy[:, None] * spectrum
        return tuple(self._image(fit.x_px, fit.y_px, one) for one in (spectrum, down_x, down_y))  # type: ignore[return-value]

    def _blur(self, blur_px: float, defocus: float) -> tuple[Array, Array]:
        """Return the blur's factor, and its derivative by ``blur_px``; ``defocus``: see EllipseFit."""
        gauss = np.exp(-2.0 * np.pi**2 * blur_px**2 * (1.0 - defocus) * self._square)
        by_gauss = -4.0 * np.pi**2 * blur_px * (1.0 - defocus) * self._square * gauss
        if defocus == 0.0:
            return gauss, by_gauss
        z = np.maximum(4.0 * np.pi * blur_px * np.sqrt(defocus * self._square), 1e-9)
        disc = 2.0 * j1(z) / z
        return gauss * disc, by_gauss * disc + gauss * 2.0 * (j0(z) - disc) / blur_px

    def _parts(self, axes: tuple[float, float, float], blur_px: float, defocus: float) -> tuple[Array, Array, Array]:
        """Return the spectrum, and its derivatives by the axes xx, yy, xy (3, ...) and by ``blur_px``."""
        xx, yy, xy = axes
        fx, fy = self._fx[None, :], self._fy[:, None]
        along, across = xx * fx + xy * fy, xy * fx + yy * fy
        far = np.hypot(along, across)
        far[len(self._fy) // 2, 0] = 1e-9
        x = 2.0 * np.pi * far
        first = j1(x)
        blur, by_blur = self._blur(blur_px, defocus)
        sharp = self._pixel * self._twice / self._period**2
        rest = sharp * blur
        determinant = xx * yy - xy * xy
        spectrum = np.pi * determinant * 2.0 * first / x * rest
        # d(2 J1(x) / x) = -2 J2(x) / x dx, and J2 = 2 J1 / x - J0
        slope = np.pi * determinant * rest * (-2.0 / x) * (2.0 * first / x - j0(x)) * 2.0 * np.pi / far
        by_area = spectrum / determinant
        by_axes = np.stack(
            [
                by_area * yy + slope * along * fx,
                by_area * xx + slope * across * fy,
                -2.0 * by_area * xy + slope * (along * fy + across * fx),
            ]
        )
        return np.asarray(spectrum), by_axes, np.asarray(np.pi * determinant * 2.0 * first / x * sharp * by_blur)

    def _waves(self, x: float, y: float) -> tuple[Array, Array]:
        along_y = np.exp(2j * np.pi * (self._at - y)[:, None] * self._fy[None, :])
        along_x = np.exp(2j * np.pi * self._fx[:, None] * (self._at - x)[None, :])
        return along_y, along_x

    def _image(self, x: float, y: float, spectrum: Array) -> Array:
        along_y, along_x = self._waves(x, y)
        return np.asarray((along_y @ spectrum @ along_x).real)

    def _columns(self, p: Array, defocus: float) -> tuple[Array, Array]:
        """Return the image of parameters p (8,) and its derivatives (size^2, 8)."""
        spectrum, by_axes, wider = self._parts((p[4], p[5], p[6]), p[7], defocus)
        down_x = -2j * np.pi * self._fx[None, :] * spectrum
        down_y = -2j * np.pi * self._fy[:, None] * spectrum
        along_y, along_x = self._waves(p[2], p[3])
        stack = np.stack([spectrum, down_x, down_y, *by_axes, wider])
        images = (along_y @ stack @ along_x).real
        disc, by_x, by_y, *others = (one.ravel() for one in images)
        ones = np.ones_like(disc)
        columns = [disc, ones, p[0] * by_x, p[0] * by_y, *(p[0] * one for one in others)]
        return p[0] * disc + p[1], np.stack(columns, axis=1)

    def fit(
        self, image: Array, sigma: Array, first: tuple[float, float, float], defocus: float = 0.0
    ) -> EllipseFit | None:
        """Fit an ellipse to a window (size, size); None where no ellipse fits.

        ``sigma`` (size, size): standard deviations of the pixels; ``first``: x, y and radius to start from [px];
        ``defocus``: share of the squared blur, see EllipseFit.
        """
        x, y, radius = first
        background = float(np.median(image[[0, -1], :]))
        level = max(float(image.max()) - background, 1e-9)
        start = np.array([1.0, 0.0, x, y, radius, radius, 0.0, 0.6])
        scaled = (image - background) / level
        weight = level / sigma

        def rest(p: Array) -> Array:
            made, _ = self._columns(p, defocus)
            return np.asarray((made - scaled.ravel()) * weight.ravel())

        def slopes(p: Array) -> Array:
            return np.asarray(self._columns(p, defocus)[1] * weight.ravel()[:, None])

        size = len(image)
        low = [0.0, -1.0, 0.0, 0.0, 0.3, 0.3, -radius, LEAST_BLUR_PX]
        high = [5.0, 1.0, size, size, size, size, radius, MOST_BLUR_PX]
        start = np.clip(start, np.add(low, 1e-6), np.subtract(high, 1e-6))
        found = least_squares(rest, start, slopes, bounds=(low, high), xtol=1e-7, ftol=1e-7)
        p = found.x
        if not found.success or p[7] < 1.01 * LEAST_BLUR_PX or p[7] > 0.99 * MOST_BLUR_PX:
            return None
        off = rest(p) / weight.ravel()
        return EllipseFit(
            p[0] * level, background + p[1] * level, p[2], p[3], (p[4], p[5], p[6]), p[7],
            float(np.sqrt(np.mean(off**2)) / p[0]), defocus,
        )  # fmt: skip
