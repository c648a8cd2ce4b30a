"""How numerical code is compiled: kernels, which Python calls, and steps, which only kernels call."""

from typing import Any

import numba

ALONE: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""For what only kernels call: without what Python would need, which takes a tenth of the time to compile."""
STEP: dict[str, Any] = {"nogil": True, "error_model": "numpy", **ALONE}

kernel = numba.njit(nogil=True, cache=True, error_model="numpy")
"""Called by Python, free of the GIL, kept compiled (``mosca.kernel_cache``)."""
step = numba.njit(**STEP)
"""Compiled into the kernels that call it; Python must not."""
