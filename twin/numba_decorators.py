"""How the twin's numerical code is compiled: kernels, which make arrays, and bare steps, which work on those.

Whoever is handed an array counts as one of its users while it works, by two locked operations of the processor, which
for steps as small as one ray through a lens took a third of the time to render. A bare step does not count: it makes
no array, returns none, and takes none from a step that makes them (``tests/test_compiled.py``).
"""

from typing import Any

import numba

_KERNEL: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_BARE: dict[str, Any] = {**_KERNEL, "_nrt": False}

kernel = numba.njit(cache=True, _nrt=True, **_KERNEL)  # type: ignore[call-overload]
"""Free of the GIL, kept compiled."""
bare_step = numba.njit(**_BARE)
"""Makes and returns no arrays; called by kernels, and by Python where a test wants to."""
inlined_step = numba.njit(forceinline=True, **_BARE)
"""A bare step that is compiled into each that calls it."""
