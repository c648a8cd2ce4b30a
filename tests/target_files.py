"""Files of calibration targets, as tests write them."""

from typing import Any

import tomli_w

from mosca.data.targets import CodedTarget, RoundTarget, TestField

SIZES = ("dot_radius_m", "ring_inner_m", "ring_outer_m", "plate_m")


def field_toml(field: TestField) -> str:
    """Return the file of a field whose coded targets, and whose plain discs, are all of one size."""
    document: dict[str, Any] = {"kind": "field", "sigma_m": field.sigma_m}
    tables: list[dict[str, Any]] = []
    for placed in field.targets:
        table = {"name": placed.name, "position_m": placed.position.tolist(), "normal": placed.normal.tolist()}
        tables.append(table | {"x_axis": placed.rotation[:, 0].tolist()})
        if isinstance(placed.target, CodedTarget):
            tables[-1]["number"] = placed.target.number
            document |= {key: getattr(placed.target, key) for key in SIZES}
        elif isinstance(placed.target, RoundTarget):
            document["plain_radius_m"] = placed.target.radius_m
    document.setdefault("dot_radius_m", document.get("plain_radius_m"))
    return tomli_w.dumps(document | {"target": tables})
