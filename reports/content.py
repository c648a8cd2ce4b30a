"""The input of a run: its settings as flat keys, and digests for equal scenes and pipelines."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from reports.record import RunRecord

WORDS = ("title", "description", "tier")
"""Keys of a scenario that change no figure and no verdict."""
CLAIM = ("expect", "caught_as", "told", "limits", "breaks", "loose_limit", "premises")
"""Keys that judge figures and do not change them."""


def settings(record: RunRecord) -> dict[str, Any]:
    """Return all settings of a run as dotted key -> value: those that affect figures, and those that judge them.

    Texts are left out. Records of live runs and of other programs have none.
    """
    parameters = record.provenance.get("parameters")
    return {} if not isinstance(parameters, Mapping) else dict(_flat(parameters, WORDS))


def content(record: RunRecord) -> dict[str, Any]:
    """Return the settings that affect figures: all but the claim and the texts; the seed is included."""
    return {key: value for key, value in settings(record).items() if key.split(".")[0] not in CLAIM}


def claim(record: RunRecord) -> dict[str, Any]:
    """Return the settings that judge figures: expectation, limits, ranges of controls."""
    return {key: value for key, value in settings(record).items() if key.split(".")[0] in CLAIM}


def content_digest(record: RunRecord) -> str:
    """Return twelve hexadecimal digits of SHA-256 over ``content`` and the source: equal for the same input."""
    text = json.dumps([record.source, content(record)], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def budget_content(parameters: Mapping[str, Any]) -> str:
    """Return a digest of the keys that affect an error budget: all but claim, texts, seed and length of the take."""
    values = {key: value for key, value in parameters.items() if key not in (*WORDS, *CLAIM, "seed")}
    values["capture"] = {key: value for key, value in values["capture"].items() if key != "duration_s"}
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


def _flat(values: Mapping[str, Any], without: tuple[str, ...] = (), above: str = "") -> Any:
    """Yield (dotted key, value) of nested tables; lists are values."""
    for key, value in values.items():
        if key in without:
            continue
        if isinstance(value, Mapping) and value:
            yield from _flat(value, (), f"{above}{key}.")
        else:
            yield f"{above}{key}", value
