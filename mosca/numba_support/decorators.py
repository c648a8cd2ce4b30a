"""How numerical code is compiled: kernels, which Python calls, and steps, which only kernels call.

All are free of exceptions for divisions by zero (``error_model="numpy"``). Kernels are kept compiled
(``mosca.numba_support.cache``).

Reference counts. Passing an array to a compiled function costs two atomic reference-count updates (Numba's NRT). With
them in all steps, side by side on one core of a shared machine (4 x 656 x 491 pixels, 200 markers, best of 3 rounds),
images to tracks took 1.10 times as long (detection 1.14 times, matching 1.18 times). A ``bare_step`` is compiled with
Numba's private flag ``_nrt=False``: it must neither allocate nor return arrays, and it must not take an array from a
step that allocates one. Numba refuses the first; ``tests/test_compiled.py`` the others.
"""

from collections.abc import Callable
from typing import Any, Protocol, overload

import numba

from mosca.numba_support.cache import kept
from mosca.numba_support.libraries import KernelCompiler, StepCompiler

FastMath = bool | set[str]
Compiled = Callable[..., Any]
"""Type of a decorated function for a type checker: Numba infers the types itself, call by call."""


class Decorator(Protocol):
    """``@kernel`` or ``@kernel(fastmath=...)``."""

    @overload
    def __call__(self, function: Callable[..., Any], /) -> Compiled: ...
    @overload
    def __call__(self, *, fastmath: FastMath) -> Callable[[Callable[..., Any]], Compiled]: ...


_COMMON: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
"""No kernel is handed to C, which would need a wrapper of its own."""
_ONLY_COMPILED: dict[str, Any] = {"no_cpython_wrapper": True}
"""Without the wrapper that Python would need, which takes a tenth of the time to compile."""


def _decorator(cached: bool, **options: Any) -> Decorator:
    def decorate(function: Any = None, *, fastmath: FastMath = False) -> Any:
        if function is None:
            return lambda f: decorate(f, fastmath=fastmath)
        pipeline = StepCompiler if options.get("no_cpython_wrapper") else KernelCompiler
        compiled = numba.njit(cache=cached, fastmath=fastmath, pipeline_class=pipeline, **{**_COMMON, **options})(
            function
        )
        return kept(compiled) if cached else compiled

    return decorate


kernel = _decorator(True)
"""Called by Python, free of the GIL, kept compiled."""
short_kernel = _decorator(True, nogil=False)
"""As ``kernel``, but keeps the GIL: for functions shorter than the time to re-acquire it."""
step = _decorator(False, _nrt=True, **_ONLY_COMPILED)
"""Compiled into the kernels that call it; not callable from Python. ``_nrt`` is set explicitly: otherwise it would
be inherited from the first caller."""
bare_step = _decorator(False, _nrt=False, **_ONLY_COMPILED)
"""As ``step``, without reference counting."""
inlined_step = _decorator(False, _nrt=False, forceinline=True, **_ONLY_COMPILED)
"""A bare step that is compiled into each of its callers: passing its many arguments costs more than its work."""
callable_bare_step = _decorator(False, _nrt=False)
"""As ``bare_step``; Python may call it too, as tests do."""
