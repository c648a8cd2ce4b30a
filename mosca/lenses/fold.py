"""Where a lens's radial mapping folds back: beyond it the model images nothing, whatever its polynomial does.

A radial polynomial fitted inside the image may turn back outside it and rise again farther out; there it is
regular once more and would image directions that no light takes to the sensor. So the mapping ends at the
first place where its slope vanishes.
"""

from collections.abc import Sequence

import numpy as np


def first_positive_root(coefficients: Sequence[float]) -> float:
    """Return the smallest positive real root of c0 + c1 s + c2 s^2 + ..., infinity where there is none."""
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(np.asarray(coefficients, dtype=float), "b"))
    positive = roots.real[np.isreal(roots) & (roots.real > 0)]
    return float(positive.min(initial=np.inf))
