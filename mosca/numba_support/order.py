"""Order of numbers for compiled code. (NumPy's ``median`` and ``argsort`` take Numba 2 s to compile, these 0.4 s.)"""

from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.numba_support.decorators import bare_step, step


@bare_step
def median_in_place(values: Array) -> Any:
    """Return the median of ``values`` (n,), which are left in another order; NaN of none (Hoare's selection)."""
    n = len(values)
    if n == 0:
        return np.nan
    middle, low, high = n // 2, 0, n - 1
    while low < high:
        pivot, i, j = values[middle], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < middle:
            low = i
        if middle < i:
            high = j
    if n % 2 == 1:
        return values[middle]
    below = values[0]
    for k in range(1, middle):
        below = max(below, values[k])
    return (below + values[middle]) / 2


@step
def stable_order(values: Array) -> Array:
    """Return the indices (n,) int64 that sort ``values`` (n,), without NaN; equal ones stay in order (merge sort)."""
    n = len(values)
    order, merged = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for k in range(n):
        order[k] = k
    width = 1
    while width < n:
        for low in range(0, n, 2 * width):
            middle, high = min(low + width, n), min(low + 2 * width, n)
            a, b = low, middle
            for k in range(low, high):
                if b >= high or (a < middle and values[order[a]] <= values[order[b]]):
                    merged[k] = order[a]
                    a += 1
                else:
                    merged[k] = order[b]
                    b += 1
        order, merged = merged, order
        width *= 2
    return order
