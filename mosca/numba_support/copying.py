"""Copies between arrays for compiled code.

``target[:] = source`` does the same, but also compiles the error text for shapes that differ. This takes a second and
a half in each process that compiles, and adds code to every kernel.
"""

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step


@bare_step
def copy_row(source: Array, target: Array) -> None:
    """Copy ``source`` (n,) to the first n values of ``target``."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@bare_step
def copy_rows(source: Array, target: Array) -> None:
    """Copy ``source`` (n, m) to the first n rows of ``target``, of as many columns."""
    for i in range(source.shape[0]):
        for k in range(source.shape[1]):
            target[i, k] = source[i, k]
