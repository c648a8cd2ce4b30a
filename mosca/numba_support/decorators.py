"""How numerical code is compiled: kernels, which Python calls, and steps, which only kernels call.

Bare steps. Whoever is handed an array counts as one of its users while it works, by two locked operations of the
processor: for a step of a few dozen operations on six arrays that is more than the step itself (half of the time that
matching took). A bare step does not count. It may so neither make an array nor return one, of which Numba says the
first when it compiles and ``tests/test_compiled.py`` the second; its caller holds what it works on.
"""

from typing import Any

import numba

_UNWRAPPED: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
ALONE: dict[str, Any] = {"_nrt": True, **_UNWRAPPED}
"""For what only kernels call: without what Python would need, which takes a tenth of the time to compile. Counting is
said, too: unsaid, it would be as in the bare step that happens to call it first."""
BARE: dict[str, Any] = {"_nrt": False, **_UNWRAPPED}
"""For what only kernels call and makes and returns no arrays: nobody counts the users of those it is given."""
STEP: dict[str, Any] = {"nogil": True, "error_model": "numpy", **ALONE}

kernel = numba.njit(nogil=True, cache=True, error_model="numpy")
"""Called by Python, free of the GIL, kept compiled (``mosca.numba_support.cache``)."""
short_kernel = numba.njit(cache=True, error_model="numpy")
"""As ``kernel``, but keeps the GIL: to win it back from another thread would take longer than what is done."""
step = numba.njit(**STEP)
"""Compiled into the kernels that call it; Python must not."""
bare_step = numba.njit(**{**STEP, **BARE})
"""As ``step``, bare."""
inlined_step = numba.njit(forceinline=True, **{**STEP, **BARE})
"""A bare step that is compiled into each that calls it: to hand its many arrays over costs more than what it does."""
