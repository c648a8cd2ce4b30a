"""Fold of a lens's radial mapping: the model images nothing beyond it, whatever its polynomial does.

A radial polynomial fitted inside the image may fold back outside it and rise again farther out; there it is regular
once more and would image directions from which no light reaches the sensor. So the mapping ends at the first radius
at which its slope vanishes.
"""

from collections.abc import Sequence

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError


def first_positive_root(coefficients: Sequence[float] | Array) -> float:
    """Return the smallest positive real root of 1 + c1 s + c2 s^2 + ..., infinity where there is none.

    ``coefficients``: 1, c1, c2, ... The polynomial is solved for 1 / s: its leading coefficient is then 1, which is
    stable for small or zero coefficients. Raises InputError for coefficients that are too large for that.
    """
    if not np.isfinite(coefficients).all():
        raise InputError(
            "lens: a radial coefficient is too large to compute with; those of real lenses are below 1e6"
        )
    inverse = np.roots(coefficients)
    largest = float(inverse.real[np.isreal(inverse)].max(initial=0.0))
    return 1.0 / largest if largest > 0.0 else float("inf")
