"""Images of blurred discs by Fourier optics on a fine grid, and the Cramer-Rao bound of a position in them."""

from functools import cache

import numpy as np
from scipy.special import j1, jn

FINE = 16  # samples a pixel
READ, BLACK = 0.5, 4.0


def transform_of_disc(diameter, f):
    """Fourier transform of a disc of flux 1 at spatial frequencies f."""
    k = np.pi * diameter * np.hypot(f[None, :], f[:, None])
    k[0, 0] = 1e-9
    return 2 * j1(k) / k


@cache
def fine_image(diameter, blur, circle=0.0, coma=0.0, across=None, cutoff=None, squeeze=1.0, dark=0.0, smear=0.0):
    """A disc of brightness 1 seen through Gaussian blur, defocus, coma and pixels, by its Fourier transform.

    The disc's is D J1(pi D f) / 2 f, a pixel's sinc; coma as third-order displacements of a pupil's points, their
    mean taken off. ``across``: edge of the image [px]. ``cutoff``: of a lens limited by diffraction [cycles a pixel],
    pixel pitch over wavelength and f-number. ``squeeze``: minor over major axis of an ellipse, along (3, 2).
    ``dark``: brightness is ``1 - dark (1 - r^2 / R^2)``, by Sonine's integral 4 pi R^2 J2(k) / k^2.
    ``smear``: along x [px].
    """
    across = across or int(diameter + 8 * blur + circle + coma) // 2 * 2 + 10
    n = across * FINE
    f = np.fft.fftfreq(n, 1 / FINE)
    gauss = np.exp(-2 * (np.pi * blur * f) ** 2) * np.sinc(f)
    u, v = (3 * f[None, :] + 2 * f[:, None]) / 13**0.5, (3 * f[:, None] - 2 * f[None, :]) / 13**0.5
    k = np.pi * diameter * np.hypot(squeeze * u, v)
    k[0, 0] = 1e-9
    spectrum = squeeze * np.pi * diameter**2 / 4 * 2 * j1(k) / k * gauss * gauss[:, None]
    if dark:
        spectrum -= dark * np.pi * diameter**2 * np.where(k < 1e-6, 1 / 8, jn(2, k) / k**2) * gauss * gauss[:, None]
    if smear:
        spectrum = spectrum * np.sinc(smear * f)
    if circle:
        spectrum = spectrum * transform_of_disc(circle, f)
    if cutoff:
        nu = np.minimum(np.hypot(f[None, :], f[:, None]) / cutoff, 1.0)
        spectrum = spectrum * 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu**2))
    if coma:
        nodes, weights = np.polynomial.legendre.leggauss(12)
        rho2, angle = (1 + nodes[:, None]) / 2, 2 * np.pi * np.arange(32) / 32
        dx = (coma / 3 * (rho2 * (2 + np.cos(2 * angle)) - 1)).ravel()
        dy = (coma / 3 * rho2 * np.sin(2 * angle)).ravel()
        weight = np.repeat(weights / 64, 32)
        low = np.abs(f) < 2
        pupil = np.zeros((n, n), complex)
        wave_x, wave_y = (np.exp(-2j * np.pi * np.outer(dx, f[low])), np.exp(-2j * np.pi * np.outer(dy, f[low])))
        pupil[np.ix_(low, low)] = (weight[:, None] * wave_y).T @ wave_x
        spectrum = spectrum * pupil
    return np.fft.fftshift(np.fft.ifft2(spectrum).real) * FINE**2


def pixels(image, ix, iy):
    """The image with its centre (ix, iy) fine samples off the middle pixel's centre."""
    n = len(image)
    at = np.arange(0, n, FINE)
    return image[np.ix_((at - iy) % n, (at - ix) % n)]


@cache
def shifted(diameter, blur, **odd):
    """Images (FINE, FINE, side, side) of a disc, none below 0: [k, m] is k, m fine samples off, from -FINE / 2 on."""
    image, off = fine_image(diameter, blur, **odd), range(-FINE // 2, FINE // 2)
    return np.array([[pixels(image, ix, iy) for iy in off] for ix in off]).clip(0)


def bound_px(diameter, blur, contrast, gain, **odd):
    """Cramer-Rao bound (x, y) with position, contrast, background and diameter unknown."""
    image = fine_image(diameter, blur, **odd)
    alike = {**odd, "across": len(image) // FINE}
    wider, smaller = (fine_image(diameter + step, blur, **alike) for step in (0.06, -0.06))
    variances = []
    for ix in range(0, FINE // 2 + 1, 4):
        for iy in range(0, FINE // 2 + 1, 4):
            shape = pixels(image, ix, iy)
            columns = [
                contrast * (pixels(image, ix + 1, iy) - pixels(image, ix - 1, iy)) * FINE / 2,
                contrast * (pixels(image, ix, iy + 1) - pixels(image, ix, iy - 1)) * FINE / 2,
                shape,
                np.ones_like(shape),
                contrast * (pixels(wider, ix, iy) - pixels(smaller, ix, iy)) / 0.12,
            ]
            jacobian = np.array([column.ravel() for column in columns])
            noise = (READ**2 + gain * contrast * shape + 1 / 12).ravel()
            variances.append(np.diag(np.linalg.inv(jacobian / noise @ jacobian.T))[:2])
    return np.sqrt(np.mean(variances, axis=0))


def frame(rng, diameter, blur, contrast, snr, n=400, **odd):
    """n targets at random positions: image, true positions (n, 2), gain."""
    images = shifted(diameter, blur, **odd)
    side = images.shape[-1]
    across = max(600 // side, 1)
    down = -(-n // across)
    gain = ((contrast / snr) ** 2 - READ**2) / contrast
    shift = rng.integers(-FINE // 2, FINE // 2, (down, across, 2))
    cells = images[shift[..., 0] + FINE // 2, shift[..., 1] + FINE // 2]
    light = contrast * cells.swapaxes(1, 2).reshape(down * side, across * side)
    noisy = BLACK + rng.poisson(light / gain) * gain + rng.normal(0, READ, light.shape)
    rows, columns = np.mgrid[:down, :across]
    truth = np.stack([columns, rows], axis=-1) * side + side // 2 + shift / FINE
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), truth.reshape(-1, 2), gain


def errors(found, truth):
    """Errors (n, 2) and stated variances of the targets that were found once."""
    nearest = np.argmin(np.linalg.norm(found.xy_px[:, None] - truth[None], axis=2), axis=1)
    assert len(np.unique(nearest)) == len(found) >= 0.98 * len(truth)
    return found.xy_px - truth[nearest], found.covariance_px2[:, [0, 1], [0, 1]]
