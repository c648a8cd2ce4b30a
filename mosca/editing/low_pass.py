"""Zero-phase Butterworth low-pass, forwards and backwards, and the covariance of independent errors after it."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve1d

from mosca.data.arrays import Array
from mosca.editing.operation import EditError

ORDER = 2
"""Order of each pass; both together are the "fourth order, zero lag" of biomechanics (Winter 2009, section
2.2.4.4)."""
SHORTEST = 10
"""Fewest frames in a row that are filtered; shorter runs stay as they are."""
MEMORY = 1.55
"""Cut-off periods after which the response has fallen to 1e-3: its poles decay by exp(-2 pi f t / sqrt 2)."""
_MOST_BLOCK = 4000


@dataclass(frozen=True, eq=False)
class LowPass:
    """A filter made for one cut-off and frame rate: ``sections`` (s, 6), ``memory`` in frames."""

    sections: Array
    memory: int

    def filtered(self, values: Array) -> Array:
        """Return ``values`` (n, k) of n frames in a row, filtered; at both ends they are extended point-mirrored."""
        from scipy.signal import sosfiltfilt  # takes a second to import

        result: Array = sosfiltfilt(self.sections, values, axis=0, padlen=min(len(values) - 1, self.memory))
        return result

    def covariance(self, given: Array) -> Array:
        """Return the covariances (n, ...) after the filter, for errors that are independent from frame to frame.

        A filtered value is a weighted sum of the given values; the covariances are summed with the squared weights.
        The weights are the filter's impulse responses, which are the same wherever the ends are too far to matter.
        """
        n, block = len(given), 6 * self.memory
        flat = np.reshape(given, (n, -1))
        size = min(n, block)
        squares = self.filtered(np.eye(size)) ** 2
        if n <= block:
            return np.reshape(squares @ flat, given.shape)
        half = size // 2
        # odd length: convolve1d centres the kernel on its middle
        kernel = squares[half, half - 2 * self.memory : half + 2 * self.memory + 1]
        out: Array = convolve1d(flat, kernel, axis=0, mode="nearest")
        out[:half] = squares[:half] @ flat[:size]
        out[-half:] = squares[-half:] @ flat[-size:]
        return np.reshape(out, given.shape)


def low_pass(cutoff_hz: float, rate_hz: float) -> LowPass:
    """Return the filter whose two passes together leave 1/sqrt 2 of an oscillation of ``cutoff_hz``.

    EditError where the cut-off is half of the frame rate or more, or too low for the filter's memory.
    """
    from scipy.signal import butter  # takes a second to import

    memory = int(np.ceil(MEMORY * rate_hz / cutoff_hz))
    lowest = MEMORY * rate_hz / (_MOST_BLOCK // 6)
    if not cutoff_hz < 0.5 * rate_hz or 6 * memory > _MOST_BLOCK:
        raise EditError(
            "cutoff_hz",
            f"{cutoff_hz:g} given; from {lowest:.3g} to below {0.5 * rate_hz:g}, half of the frame rate, is allowed",
        )
    # |H|^2 = 1 / (1 + (w / w0)^2n) of one pass must be 1 / sqrt 2 at the cut-off, with w = tan(pi f / rate)
    tangent = np.tan(np.pi * cutoff_hz / rate_hz) / (np.sqrt(2.0) - 1.0) ** (0.5 / ORDER)
    return LowPass(butter(ORDER, 2.0 / np.pi * np.arctan(tangent), output="sos"), memory)
