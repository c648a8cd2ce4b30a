"""Linear equations of a symmetric positive definite matrix, for compiled code."""

import math
from typing import Any

from mosca.numba_support.decorators import bare_step


@bare_step
def solve(normal: Any, right: Any, n: int) -> bool:
    """Replace ``right`` (n, k) by the solution with a symmetric ``normal`` (n, n); False where there is none.

    Of ``normal`` the lower triangle is read, and replaced by its Cholesky factor.
    """
    for a in range(n):
        for b in range(a + 1):
            total = normal[a, b]
            for k in range(b):
                total -= normal[a, k] * normal[b, k]
            if a > b:
                normal[a, b] = total / normal[b, b]
            elif total > 0.0:
                normal[a, a] = math.sqrt(total)
            else:
                return False
    for c in range(right.shape[1]):
        for a in range(n):
            for k in range(a):
                right[a, c] -= normal[a, k] * right[k, c]
            right[a, c] /= normal[a, a]
        for a in range(n - 1, -1, -1):
            for k in range(a + 1, n):
                right[a, c] -= normal[k, a] * right[k, c]
            right[a, c] /= normal[a, a]
    return True
