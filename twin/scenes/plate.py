"""Bending of a thin rectangular plate, simply supported at its rim: modes in closed form, driven by random forces.

Kirchhoff's plate: mode (m, n) has the shape sin(m pi x / a) sin(n pi y / b) and the frequency
(pi / 2) (m^2 / a^2 + n^2 / b^2) sqrt(D / (rho h)), D = E h^3 / (12 (1 - nu^2)) (Leissa, Vibration of Plates, NASA
SP-160, 1969, equation 4.20). All modes have the same generalised mass. So forces that are random over the whole plate
drive all modes independently, with the same spectrum.
"""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array, read_only, set_read_only

FORCE_STEPS = 20
"""Steps of the force in a period of its highest frequency. Holding the force between steps reduces the amplitude at
that frequency by pi^2 / (6 * 20^2) = 0.4 %, and by less below."""
_RUN_IN = 7.0  # time constants of the slowest mode: e^-7 of the start is left


@dataclass(frozen=True, eq=False)
class PlateModes:
    """Modes of a plate, lowest first, at the positions of its m targets."""

    frequency_hz: Array
    """(k,) undamped natural frequencies [Hz]."""
    damping: Array
    """(k,) shares of critical damping."""
    shapes: Array
    """(m, k) deflection of each target for a unit of each mode; the largest deflection on the plate is 1."""
    slopes: Array
    """(m, k, 2) derivatives of the shapes along x and y [1/m]."""

    def __post_init__(self) -> None:
        k = len(np.asarray(self.frequency_hz))
        set_read_only(self, frequency_hz=(k,), damping=(k,), shapes=(None, k))
        set_read_only(self, slopes=(len(self.shapes), k, 2))


@dataclass(frozen=True)
class ThinPlate:
    """A plate: edges [m], thickness [m], Young's modulus [Pa], Poisson's ratio, density [kg/m^3]."""

    size_m: tuple[float, float]
    thickness_m: float
    youngs_pa: float
    poisson: float
    density_kg_m3: float

    def modes(self, xy_m: Array, n: int, damping: Array) -> PlateModes:
        """Return the ``n`` lowest modes at targets ``xy_m`` (m, 2) from a corner; ``damping`` (n,)."""
        a, b = self.size_m
        rigidity = self.youngs_pa * self.thickness_m**3 / (12 * (1 - self.poisson**2))
        speed = np.pi / 2 * np.sqrt(rigidity / (self.density_kg_m3 * self.thickness_m))
        # the n-th lowest mode has at most n half waves in either direction
        waves = np.stack(np.meshgrid(np.arange(1, n + 1), np.arange(1, n + 1), indexing="ij"), -1).reshape(-1, 2)
        frequency = speed * ((waves / np.array([a, b])) ** 2).sum(axis=1)
        lowest = np.argsort(frequency, kind="stable")[:n]
        number = np.pi * waves[lowest] / np.array([a, b])  # (n, 2) [rad/m]
        x, y = (xy_m[:, None, axis] * number[:, axis] for axis in (0, 1))
        slopes = np.stack([number[:, 0] * np.cos(x) * np.sin(y), number[:, 1] * np.sin(x) * np.cos(y)], axis=-1)
        return PlateModes(frequency[lowest], damping, np.sin(x) * np.sin(y), slopes)


@dataclass(frozen=True, eq=False)
class ModalResponse:
    """Deflection of each mode at any time: q'' + 2 zeta w q' + w^2 q = f, with f held between steps.

    With z' = lambda z + f, lambda = -zeta w + i wd, it is q = Im(z) / wd; a step of a constant f is exact.
    """

    pole: Array
    """(k,) lambda [rad/s]."""
    first_s: float
    step_s: float
    state: Array
    """(s, k) z at the beginning of each step."""
    force: Array
    """(s, k) f during it [m/s^2]."""

    def __call__(self, time_s: float) -> Array:
        """Return q (k,) at ``time_s`` [m]."""
        at = min(max(int((time_s - self.first_s) / self.step_s), 0), len(self.state) - 1)
        grown = np.exp(self.pole * (time_s - self.first_s - at * self.step_s))
        z = grown * self.state[at] + (grown - 1) / self.pole * self.force[at]
        return np.asarray(z.imag / self.pole.imag)


def random_response(
    modes: PlateModes,
    band_hz: tuple[float, float],
    rms_m: float,
    span_s: tuple[float, float],
    rng: np.random.Generator,
) -> ModalResponse:
    """Return the modes' steady response to independent Gaussian forces, white within ``band_hz``.

    ``rms_m``: root of the sum of the modes' mean squares, as with forces that are white at all frequencies: a force
    of one-sided density S gives a mean square of S / (8 zeta w^3). ``span_s``: first and last time needed [s].
    """
    w = 2 * np.pi * modes.frequency_hz
    density = rms_m**2 / np.sum(1 / (8 * modes.damping * w**3))
    run_in_s = _RUN_IN / float(np.min(modes.damping * w))
    from scipy.signal import lfilter  # takes a second to import

    step_s = 1 / (FORCE_STEPS * band_hz[1])
    begin = int(np.ceil(run_in_s / step_s))
    steps = begin + int(np.ceil((span_s[1] - span_s[0]) / step_s)) + 1
    white = rng.standard_normal((steps, len(w))) * np.sqrt(density / (2 * step_s))
    spectrum = np.fft.rfft(white, axis=0)
    frequency = np.fft.rfftfreq(steps, step_s)
    spectrum[(frequency < band_hz[0]) | (frequency > band_hz[1])] = 0
    force = np.fft.irfft(spectrum, steps, axis=0)
    pole = w * (-modes.damping + 1j * np.sqrt(1 - modes.damping**2))
    grown = np.exp(pole * step_s)
    state = np.stack(
        [
            lfilter([0, (grown[k] - 1) / pole[k]], [1, -grown[k]], force[:, k].astype(np.complex128))
            for k in range(len(w))
        ],
        axis=1,
    )
    kept = (steps - begin, len(w))
    return ModalResponse(
        pole, span_s[0], step_s, read_only(state[begin:], kept, "state", np.complex128),
        read_only(force[begin:], kept, "force"),
    )  # fmt: skip
