"""``[limits]`` and ``[breaks]`` of a scenario: numbers in the metric's unit, texts with a unit, keys that end in one.

``position_rms = 0.0005``, ``position_rms = "0.5 mm"`` and ``position_rms_mm = 0.5`` have the same meaning. They are
read as a number in the unit of ``reports.metrics.METRICS``; a limit that has no meaning for its metric is refused.
Two numbers are a range in which the value must lie, as ``nees = [2, 4]`` in ``[limits]``, and each entry of
``[breaks]``.
"""

import difflib
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from pydantic import ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from reports.metrics import METRICS, MetricKind, Quantity

UNITS: dict[Quantity, dict[str, float]] = {
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6},
    "share": {"%": 1e-2, "percent": 1e-2, "ppm": 1e-6},
    "count": {},
    "ratio": {},
    "ppm": {"ppm": 1.0},
    "image": {"px": 1.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6},
    "rate": {"1/s": 1.0, "Hz": 1.0, "hz": 1.0, "fps": 1.0},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
    "turning": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180},
}
"""Units of a text or of a key's ending, and the value of one such unit in the metric's own unit."""
_NAMED = {
    "length": "a length",
    "share": "a share",
    "count": "a count",
    "ratio": "a ratio",
    "ppm": "a drift in parts per million",
    "image": "a distance in the image",
    "angle": "an angle",
    "time": "a time",
    "rate": "a rate",
    "speed": "a speed",
    "turning": "a rate of turning",
}
_EXAMPLES = {
    "length": '0.5 mm is 0.0005, "0.5 mm" or {name}_mm = 0.5',
    "share": '99 % is 0.99, "99 %" or {name}_percent = 99',
    "count": "0 allows none",
    "ratio": "a bare number is wanted",
    "ppm": '5 ppm is 5 or "5 ppm"',
    "image": '0.2 px is 0.2, "0.2 px" or {name}_px = 0.2',
    "angle": '2 mrad is 0.002, "2 mrad" or {name}_mrad = 2',
    "time": '5 ms is 0.005, "5 ms" or {name}_ms = 5',
    "rate": '100 frame sets a second are 100 or "100 Hz"',
    "speed": '5 mm/s is 0.005 or "5 mm/s"',
    "turning": '0.5 deg/s is 0.0087 or "0.5 deg/s"',
}
_WITH_UNIT = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S+)\s*")


def read_limits(given: Any) -> Any:
    """Return ``[limits]`` as metric -> limit, or range, in the metric's unit; anything but a table is returned as is.

    Raises pydantic's ValidationError, whose locations are the keys as given.
    """
    return _read(given, _limit, "limits")


def read_breaks(given: Any) -> Any:
    """Return ``[breaks]`` as metric -> range (low, high) in the metric's unit; otherwise as ``read_limits``."""
    return _read(given, _range, "is a range of")


def _read(given: Any, read: Callable[[str, Any, str, str], Any], says: str) -> Any:
    if not isinstance(given, Mapping):
        return given
    found: dict[str, Any] = {}
    keys: dict[str, str] = {}
    for key, value in _flat(given):
        name, ending = _metric_and_unit(key, value)
        if name in keys:
            _refuse(key, value, f"'{keys[name]}' {says} {name} already; leave one of them out")
        keys[name] = key
        found[name] = read(key, value, name, ending)
    return found


def end_of(name: str, limit: float | tuple[float, float]) -> float:
    """Return the limit of a metric; for a range, its end on the bad side."""
    if isinstance(limit, tuple):
        return limit[METRICS[name].sense == "at_most"]
    return limit


def range_of(name: str) -> str:
    """Return the possible limits of a metric in words."""
    kind = METRICS[name]
    first = "above 0" if kind.sense == "at_least" else "from 0"
    last = "" if math.isinf(kind.highest) else f" to {kind.highest:.4g}"
    unit = "" if kind.unit == "1" else f" {kind.unit}"
    return f"{name} is {_NAMED[kind.quantity]} {first}{last}{unit}"


def limits_schema() -> dict[str, Any]:
    """Return the JSON schema of ``[limits]``: each metric in its unit, as a text, and with its unit in the key."""
    properties = {}
    for key, one in _properties().items():
        choices = one.get("anyOf", [{name: value for name, value in one.items() if name != "description"}])
        properties[key] = {"anyOf": [*choices, _range_schema({"anyOf": choices})], "description": one["description"]}
    return _table_schema(properties)


def breaks_schema() -> dict[str, Any]:
    """Return the JSON schema of ``[breaks]``: as that of ``[limits]``, with ranges only."""
    return _table_schema({key: _range_schema(one) for key, one in _properties().items()})


def _properties() -> dict[str, Any]:
    """Return the schema of a number for each possible key."""
    properties: dict[str, Any] = {}
    for name, kind in METRICS.items():
        texts = "|".join(re.escape(unit) for unit in UNITS[kind.quantity])
        number = _number_schema(kind)
        text = [{"type": "string", "pattern": rf"^\s*\+?[0-9.]+([eE][+-]?[0-9]+)?\s*({texts})\s*$"}] if texts else []
        properties[name] = {"anyOf": [number, *text], "description": f"{range_of(name)}; {_example(name)}"}
        for unit, factor in UNITS[kind.quantity].items():
            if _is_ending(unit):
                ending = _number_schema(kind, factor)
                properties[f"{name}_{unit}"] = {**ending, "description": f"{name} in {unit}"}
    return properties


def _range_schema(limit: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": limit, "minItems": 2, "maxItems": 2}


def _table_schema(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "additionalProperties": False, "default": {}}


def _number_schema(kind: MetricKind, factor: float = 1.0) -> dict[str, Any]:
    lowest = "exclusiveMinimum" if kind.sense == "at_least" else "minimum"
    highest = {} if math.isinf(kind.highest) else {"maximum": kind.highest / factor}
    return {"type": "number", lowest: 0, **highest}


def _flat(table: Mapping[str, Any], before: str = "") -> list[tuple[str, Any]]:
    """Return dotted keys and values: TOML reads ``efficiency.detect = 0.9`` as a table in a table."""
    pairs: list[tuple[str, Any]] = []
    for key, value in table.items():
        name = f"{before}{key}"
        pairs += _flat(value, f"{name}.") if isinstance(value, Mapping) else [(name, value)]
    return pairs


def _metric_and_unit(key: str, value: Any) -> tuple[str, str]:
    """Return the metric of a key and the unit that the key ends in, "" for none."""
    if key in METRICS:
        return key, ""
    name, _, ending = key.rpartition("_")
    if name in METRICS:
        endings = [unit for unit in UNITS[METRICS[name].quantity] if _is_ending(unit)]
        if ending in endings:
            return name, ending
        wanted = ", ".join(f"{name}_{unit}" for unit in endings)
        _refuse(key, value, f"{range_of(name)}; its keys are {', '.join(filter(None, (name, wanted)))}")
    near = difflib.get_close_matches(key, METRICS, n=1)
    suggestion = f"did you mean '{near[0]}'? There are" if near else "there are"
    _refuse(key, value, f"'{key}' is no metric; {suggestion} {', '.join(METRICS)}")


def _number(key: str, value: Any, name: str, ending: str) -> float:
    kind = METRICS[name]
    units = UNITS[kind.quantity]
    number, factor = value, units.get(ending, 1.0)
    if isinstance(value, str) and not ending:
        found = _WITH_UNIT.fullmatch(value)
        if found is None or found[2] not in units:
            texts = f"a number or a text with a unit of {', '.join(units)}" if units else "a number"
            _refuse(key, value, f"{texts} is wanted; {range_of(name)}: {_example(name)}")
        number, factor = float(found[1]), units[found[2]]
    if isinstance(number, bool) or not isinstance(number, int | float):
        _refuse(key, value, f"a number is wanted; {range_of(name)}: {_example(name)}")
    limit = float(number) * factor
    if not kind.allows(limit):
        never = "; a lower limit of 0 is never broken" if limit == 0 else ""
        _refuse(key, value, f"{range_of(name)}{never}: {_example(name)}")
    return limit


def _limit(key: str, value: Any, name: str, ending: str) -> float | tuple[float, float]:
    return (_range if isinstance(value, list | tuple) else _number)(key, value, name, ending)


def _range(key: str, value: Any, name: str, ending: str) -> tuple[float, float]:
    wanted = f"two numbers, the smaller one first, are wanted: {name} = [low, high]"
    if not isinstance(value, list | tuple) or len(value) != 2:
        _refuse(key, value, wanted)
    low, high = (_number(key, end, name, ending) for end in value)
    if not low < high:
        _refuse(key, value, wanted)
    return low, high


def _is_ending(unit: str) -> bool:
    return re.fullmatch("[a-z]+", unit) is not None


def _example(name: str) -> str:
    return _EXAMPLES[METRICS[name].quantity].format(name=name)


def _refuse(key: str, value: Any, message: str) -> NoReturn:
    wrong = PydanticCustomError("limit", "{message}", {"message": message})
    raise ValidationError.from_exception_data("limits", [InitErrorDetails(type=wrong, loc=(key,), input=value)])
