"""Figures as readable texts: millimetres, percents, three significant digits."""

import math
from collections.abc import Sequence

from reports.metrics import kind_of


def shown(values: Sequence[float], unit: str, name: str = "") -> tuple[tuple[float, ...], str]:
    """Return ``values`` of one row in the unit that reads best, and that unit's name.

    m below 0.5 m become mm, s below 1 s ms, rad below 0.1 rad mrad (angles of joints degrees), shares percent; px and
    others stay. All values of a row share a unit, chosen by the first.
    """
    factor, text = _scale(abs(values[0]) if values else 0.0, unit, name)
    return tuple(value * factor for value in values), text


def _scale(size: float, unit: str, name: str) -> tuple[float, str]:
    if unit == "m" and size < 0.5:
        return 1e3, "mm"
    if unit == "s" and size < 1.0:
        return 1e3, "ms"
    kind = kind_of(name)
    if unit == "rad" and kind is not None and kind.shown_in == "deg":
        return 180 / math.pi, "deg"
    if unit == "rad" and size < 0.1:
        return 1e3, "mrad"
    if unit == "1":
        return (100.0, "%") if kind is not None and kind.quantity == "share" else (1.0, "")
    return 1.0, unit


def figure(value: float) -> str:
    """Return ``value`` with three significant digits, more just below 1 and 100 (99.987)."""
    if not math.isfinite(value):
        return "∞" if value == math.inf else ("−∞" if value == -math.inf else "–")
    if value == 0:
        return "0"
    if value == int(value) and abs(value) < 1e6:
        return f"{int(value):,}".replace(",", " ").replace("-", "−")
    places = max(0, 2 - math.floor(math.log10(abs(value))))
    for whole in (1.0, 100.0):  # the difference to 1 or 100 % is of interest: two digits of it
        if 0.9 * whole <= value < whole:
            places = max(places, 1 - math.floor(math.log10(whole - value)))
    if places > 9:
        return f"{value:.2e}".replace("-", "−")
    text = f"{value:,.{places}f}".replace(",", " ")
    if places > 0:
        text = text.rstrip("0").rstrip(".")
    return text.replace("-", "−")


def duration(seconds: float) -> str:
    """Return ``seconds`` as a short text: 12 ms, 4.3 s, 3 min 20 s."""
    if seconds < 1:
        return f"{1e3 * seconds:.3g} ms"
    if seconds < 120:
        return f"{seconds:.3g} s"
    return f"{int(seconds // 60)} min {int(seconds % 60)} s"
