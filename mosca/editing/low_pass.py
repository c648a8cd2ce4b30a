"""Zero-phase Butterworth low-pass: forwards and backwards, with what it does to independent errors."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve1d

from mosca.data.arrays import Array
from mosca.editing.operation import EditError

ORDER = 2
"""Of each pass: together the "fourth order, zero lag" of biomechanics (Winter 2009, section 2.2.4.4)."""
SHORTEST = 10
"""Frames in a row that are filtered; fewer are left as they are."""
MEMORY = 1.55
"""Cut-off periods after which the response has fallen to 1e-3: its poles decay by exp(-2 pi f t / sqrt 2)."""
_MOST_BLOCK = 4000


@dataclass(frozen=True, eq=False)
class LowPass:
    """A filter made for one cut-off and frame rate: ``sections`` (s, 6), ``memory`` in frames."""

    sections: Array
    memory: int

    def filtered(self, values: Array) -> Array:
        """Return ``values`` (n, k) of n frames in a row, filtered; they go on point-mirrored at both ends."""
        from scipy.signal import sosfiltfilt  # takes a second to import

        result: Array = sosfiltfilt(self.sections, values, axis=0, padlen=min(len(values) - 1, self.memory))
        return result

    def covariance(self, given: Array) -> Array:
        """Return the covariances (n, ...) after the filter of errors that were independent from frame to frame.

        A filtered value is a sum of the given ones with weights: their squares weigh the covariances. They are the
        filter's answers to single impulses, the same ones wherever the ends are too far to matter.
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
    """Return the filter that leaves 1/sqrt 2 of an oscillation of ``cutoff_hz``, both passes together.

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
    # |H|^2 = 1 / (1 + (w / w0)^2n) of one pass is to be 1 / sqrt 2 at the cut-off, w = tan(pi f / rate)
    tangent = np.tan(np.pi * cutoff_hz / rate_hz) / (np.sqrt(2.0) - 1.0) ** (0.5 / ORDER)
    return LowPass(butter(ORDER, 2.0 / np.pi * np.arctan(tangent), output="sos"), memory)
