"""Where two readings of a file differ: nested values of any kind."""

from collections.abc import Mapping
from typing import Any

import numpy as np

NEAR = 1e-9
"""Of two computations of one number, relative to the largest of its array."""


def difference(ours: Any, theirs: Any, where: str = "") -> str:
    """Return the place and the two values at the first difference, "" for none. NaN equals NaN."""
    if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        if list(map(str, ours)) != list(map(str, theirs)) and set(ours) != set(theirs):
            return f"{where}: names {sorted(map(str, ours))} against {sorted(map(str, theirs))}"
        found = (difference(ours[key], theirs[key], f"{where}.{key}") for key in ours)
        return next((one for one in found if one), "")
    if isinstance(ours, list | tuple) and isinstance(theirs, list | tuple):
        if len(ours) != len(theirs):
            return f"{where}: {len(ours)} against {len(theirs)}: {ours!r:.200} against {theirs!r:.200}"
        found = (difference(a, b, f"{where}[{k}]") for k, (a, b) in enumerate(zip(ours, theirs, strict=True)))
        return next((one for one in found if one), "")
    if isinstance(theirs, str) and isinstance(ours, int | float) and not isinstance(ours, bool):
        theirs = _quoted(theirs)
    if isinstance(ours, str | None) or isinstance(theirs, str | None):
        return "" if ours == theirs else f"{where}: {ours!r:.100} against {theirs!r:.100}"
    a, b = np.asarray(ours), np.asarray(theirs)
    if a.dtype.kind == "f" and b.dtype.kind == "U":
        b = np.vectorize(_quoted, otypes=[object])(b)
    if a.shape != b.shape:
        return f"{where}: shape {a.shape} against {b.shape}"
    if (a.dtype.kind == "b") != (b.dtype.kind == "b"):
        return f"{where}: {a.dtype} against {b.dtype}"
    a, b = (
        one.astype(float) if one.dtype == object and _numeric(one) else one for one in (a, b)
    )  # whole numbers beyond 64 bit
    if a.dtype.kind in "OUSb" or b.dtype.kind in "OUSb":
        same = a.astype(str) == b.astype(str) if a.dtype.kind in "OUS" or b.dtype.kind in "OUS" else a == b
    elif a.dtype.kind in "iu" and b.dtype.kind in "iu":
        same = a == b
    else:
        with np.errstate(all="ignore"):
            a, b = a.astype(float), b.astype(float)
            largest = np.max(np.abs(b[np.isfinite(b)]), initial=0.0)
            same = (a == b) | (np.isnan(a) & np.isnan(b)) | (np.abs(a - b) <= NEAR * largest)
    if np.all(same):
        return ""
    at = tuple(int(k) for k in np.argwhere(~np.asarray(same))[0]) if a.shape else ()
    return f"{where}{list(at) if at else ''}: {a[at]!r} against {b[at]!r}"


def _quoted(text: str) -> Any:
    """Return the number that a text holds, else the text: TOML tables take a number in quotes."""
    try:
        return float(text)
    except ValueError:
        return text


def _numeric(values: np.ndarray) -> bool:
    return all(isinstance(one, int | float) for one in values.flat)
