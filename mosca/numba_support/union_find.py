"""Disjoint sets for compiled code: ``parent`` (n,) holds for each element another of its set, for a root itself.

The root of a set is its smallest element, so that sets come out in the order of their first elements.
"""

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step


@bare_step
def root_of(parent: Array, k: int) -> int:
    """Return the root of the set of ``k``; halves the path to it on the way (Tarjan and van Leeuwen 1984)."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@bare_step
def unite(parent: Array, i: int, k: int) -> None:
    """Unite the sets of ``i`` and ``k``."""
    a, b = root_of(parent, i), root_of(parent, k)
    parent[max(a, b)] = min(a, b)
