"""Point spread function of a lens: the pupil in patches, each with the same blur.

The light through one patch of the pupil lands beside the ideal image. Defocus displaces it in proportion to the
position in the pupil, coma with the square of that position and with the field (the ray aberrations of Seidel's
theory). All patches are blurred by one Gaussian, which models diffraction and small residual aberrations. So every
point spread function is a sum of shifted Gaussians, exact for any target, without tabulated images. The mean
displacement is subtracted, so that the lens model (``twin.cameras.optics.lens``) places the light's centroid.
"""

import math
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import callable_bare_step, step
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.optics.pixel_kernel import PixelKernel, gaussian_kernel

SHARP_PX = 0.02
"""Displacements below this are left out: their blur adds at most 1e-4 px^2 to the variance of the spread."""
MOST_RINGS = 12
_NODES = [np.polynomial.legendre.leggauss(n) for n in range(1, MOST_RINGS + 1)]
_AT = np.zeros((MOST_RINGS + 1, MOST_RINGS))
_SHARE = np.zeros((MOST_RINGS + 1, MOST_RINGS))
for _n, (_at, _weight) in enumerate(_NODES, start=1):
    _AT[_n, :_n], _SHARE[_n, :_n] = (_at + 1) / 2, _weight / 2


@dataclass(frozen=True, eq=False)
class Psf:
    """The blur of a lens."""

    kernel: PixelKernel
    """Pixel kernel of one patch of the pupil."""
    terms: Array
    """(9,): focus distance [m] (0: sharp everywhere), blur circle per unit of defocus [px], focal length [m],
    curvature, coma [px at the corner], image centre (x, y), half diagonal, sigma [px]."""


def psf_of(optics: Optics, width: int, height: int) -> Psf:
    """Return the spread of a lens with these ``optics`` on an image of ``width`` x ``height``."""
    focal_m = optics.f_mm * 1e-3
    if optics.focus_m is not None and optics.focus_m <= focal_m:
        raise ValueError(f"focus_m = {optics.focus_m}: farther than the focal length {focal_m} m is wanted")
    aperture_px = focal_m * focal_m / optics.f_number / (optics.pixel_pitch_mm * 1e-3)
    terms = np.array(
        [
            optics.focus_m or 0.0, aperture_px, focal_m, optics.curvature_px, optics.coma_px,
            (width - 1) / 2, (height - 1) / 2, math.hypot(width, height) / 2, optics.psf_sigma_px,
        ]
    )  # fmt: skip
    terms.setflags(write=False)
    return Psf(gaussian_kernel(optics.psf_sigma_px), terms)


def blur_circle_px(optics: Optics, distance_m: float) -> float:
    """Return the diameter of the geometric blur circle at a distance on the axis, signed (thin lens) [px].

    ``f^2 / N (d - d_focus) / (d (d_focus - f))``: positive behind the plane of focus.
    """
    return float(_blur_circle(psf_of(optics, 2, 2).terms, distance_m))


@callable_bare_step
def _blur_circle(terms: Array, distance: float) -> float:
    focus, aperture, focal = terms[0], terms[1], terms[2]
    if focus == 0.0:
        return 0.0
    return float(aperture * (distance - focus) / (distance * (focus - focal)))


@step
def patches(terms: Array, u: float, v: float, distance: float) -> Array:
    """Return the patches (n, 3) of a point imaged at (u, v): displacement x, y [px] and share.

    ``distance``: along the axis, with a fisheye in space [m].

    Nodes are Gauss-Legendre in the pupil's area and at equal angles around it: as many as it takes for the Gaussian
    of ``sigma`` to blur them into one.
    """
    x, y = (u - terms[5]) / terms[7], (v - terms[6]) / terms[7]
    field = math.sqrt(x * x + y * y)
    radius = 0.5 * (_blur_circle(terms, distance) + terms[3] * field * field)
    comatic = terms[4] * field / 3.0
    reach = abs(radius) + 1.5 * abs(comatic)
    if reach < 0.5 * SHARP_PX:
        return np.array([[0.0, 0.0, 1.0]])
    along_x, along_y = (x / field, y / field) if field > 0.0 else (1.0, 0.0)
    spread = math.sqrt(terms[8] * terms[8] + 1.0 / 12.0)
    rings = min(MOST_RINGS, 2 + int(0.8 * reach / spread))
    out = np.empty((rings * (7 + int(3.0 * reach / spread)), 3))
    n = 0
    for i in range(rings):
        rho2 = _AT[rings, i]
        rho = math.sqrt(rho2)
        around = 7 + int(3.0 * rho * reach / spread)
        for k in range(around):
            angle = 2.0 * math.pi * (k + 0.5 * (i % 2)) / around
            c, s = math.cos(angle), math.sin(angle)
            # in the radial direction and across it; the mean of 2 rho^2 over the pupil is 1
            radial = radius * rho * c + comatic * (rho2 * (2.0 + 2.0 * c * c - 1.0) - 1.0)
            across = radius * rho * s + comatic * rho2 * 2.0 * c * s
            out[n, 0] = radial * along_x - across * along_y
            out[n, 1] = radial * along_y + across * along_x
            out[n, 2] = _SHARE[rings, i] / around
            n += 1
    return out[:n]
