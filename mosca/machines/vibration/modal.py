"""Modes and the comparison of their shapes: modal assurance criterion, phase collinearity, real shapes."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, set_read_only


@dataclass(frozen=True, eq=False)
class Mode:
    """A mode of vibration, or a steady line that is driven by the excitation."""

    frequency_hz: float
    frequency_sigma_hz: float
    damping: float
    """Damping as a share of critical damping."""
    damping_sigma: float
    shape: Array
    """(c,) real, one number per channel, the largest of absolute value 1."""
    mpc: float
    """Modal phase collinearity of the complex shape: 1 where all channels move in phase or in antiphase."""
    rms_m: float
    """Rms displacement where the shape is 1 [m]."""
    kurtosis: float
    """Kurtosis of the displacement: 3 for a mode driven by random forces, 1.5 for a steady line."""
    orders: float
    """Share of the model orders that have the mode, counted from the first in which it is found."""
    is_line: bool = False
    """Whether it is a steady line instead of a mode."""

    def __post_init__(self) -> None:
        set_read_only(self, shape=(None,))


def looks_steady(kurtosis: float, frequency_hz: float, damping: float, length_s: float) -> bool:
    """Return whether a peak is a steady line: nearer to a sine's kurtosis of 1.5 than to a Gaussian's 3, and narrow.

    A mode also has a low kurtosis where the record is only a few of its time constants long; its peak, 2 zeta f wide,
    is then still wider than the record's resolution 1 / T.
    """
    return kurtosis < 2.25 and 2 * damping * frequency_hz * length_s < 1.0


def mac(first: Array, second: Array) -> Array:
    """Return the modal assurance criterion (j, k) of shapes (c, j) and (c, k), complex or real: 1 for the same shape.

    |a^H b|^2 / (a^H a b^H b) (Allemang and Brown, 1982).
    """
    a, b = (np.asarray(shapes).reshape(len(shapes), -1) for shapes in (first, second))
    across = np.abs(a.conj().T @ b) ** 2
    own = [np.sum(np.abs(shapes) ** 2, axis=0) for shapes in (a, b)]
    return np.asarray(across / np.outer(*own))


def phase_collinearity(shape: Array) -> float:
    """Return the modal phase collinearity of a complex shape (c,): 1 on a line of the complex plane, 0 on a circle.

    Pappa, Elliott and Schenk (1993), without their removal of the mean, which would remove a rigid shape itself.
    """
    x, y = shape.real, shape.imag
    spread = np.array([[x @ x, x @ y], [x @ y, y @ y]])
    low, high = np.linalg.eigvalsh(spread)
    return float(((high - low) / (high + low)) ** 2)


def real_shape(shape: Array) -> Array:
    """Return the real part of a complex shape (c,) after turning it to be as real as possible, its largest one 1."""
    # the phase that makes the sum of squares real also maximises the real part's share
    turned = shape * np.exp(-0.5j * np.angle(np.sum(shape**2)))
    real = turned.real
    return np.asarray(real / real[np.argmax(np.abs(real))])


def frequency_bound(frequency_hz: float, damping: float, length_s: float) -> float:
    """Return the smallest relative standard deviation of a frequency that random excitation for ``length_s`` allows.

    It is sqrt(zeta / (2 pi f T)). A periodogram's independent, exponentially distributed ordinates (Whittle) have the
    information T * integral (d ln S / dp)^2 df on a parameter p. Near a resonance S ~ 1 / ((f - f0)^2 + h^2) with
    h = zeta f0, which gives 2 pi T / h for f0 and, with known density of the force, the same for h. Gersch (1974)
    gives the same order.
    """
    return float(np.sqrt(damping / (2 * np.pi * frequency_hz * length_s)))


def damping_bound(frequency_hz: float, damping: float, length_s: float) -> float:
    """Return the same bound for a damping: 1 / sqrt(2 pi f zeta T)."""
    return float(1 / np.sqrt(2 * np.pi * frequency_hz * damping * length_s))
