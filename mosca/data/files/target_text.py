"""Text of target files, from the objects that ``mosca.data.files.target_file`` returns when it reads them."""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import tomli_w

from mosca.data.boards import Board
from mosca.data.files.target_tables import CalibrationTarget
from mosca.data.targets import BallTarget, CodedTarget, RoundTarget, ScaleBar, TestField
from mosca.data.wands import LFrame, SingleLight, Wand

Document = dict[str, Any]
SIZES = ("dot_radius_m", "ring_inner_m", "ring_outer_m", "plate_m")


def target_toml(target: CalibrationTarget) -> str:
    """Return the target file of ``target``, every number at full precision.

    Raises ValueError for a field whose coded targets, or plain discs, differ in size: a file states one size of each.
    """
    document = next(made(target) for kind, made in _MADE.items() if isinstance(target, kind))
    return tomli_w.dumps({key: value for key, value in document.items() if value is not None})


def _field(field: TestField) -> Document:
    document: Document = {"kind": "field", "sigma_m": field.sigma_m}
    tables: list[Document] = []
    for placed in field.targets:
        table = {"name": placed.name, "position_m": placed.position.tolist(), "normal": placed.normal.tolist()}
        tables.append(table | {"x_axis": placed.rotation[:, 0].tolist()})
        sizes: Document = {}
        if isinstance(placed.target, CodedTarget):
            tables[-1]["number"] = placed.target.number
            sizes = {key: getattr(placed.target, key) for key in SIZES}
        elif isinstance(placed.target, RoundTarget):
            sizes = {"plain_radius_m": placed.target.radius_m}
        for key, value in sizes.items():
            if document.setdefault(key, value) != value:
                raise ValueError(f"target '{placed.name}': {key} = {value:g}; those before it have {document[key]:g}")
    document.setdefault("dot_radius_m", document.get("plain_radius_m"))
    return document | {"target": tables}


def _board(board: Board) -> Document:
    return {"kind": "board", **asdict(board)}


def _wand(wand: Wand) -> Document:
    return {"kind": "wand", **asdict(wand), "along_m": list(wand.along_m)}


def _light(light: SingleLight) -> Document:
    apart = None if light.between is None else light.apart_m
    between = None if light.between is None else list(light.between)
    return {"kind": "light", **asdict(light), "between": between, "apart_m": apart}


def _l_frame(frame: LFrame) -> Document:
    balls = [{"name": n, "position_m": p.tolist()} for n, p in zip(frame.names, frame.positions, strict=True)]
    return {"kind": "l_frame", "diameter_m": frame.diameter_m, "sigma_m": frame.sigma_m, "marker": balls}


def _scale_bar(bar: ScaleBar) -> Document:
    one, two = bar.ends
    ends: Document = {}
    if isinstance(one, CodedTarget) and isinstance(two, CodedTarget):
        ends = {"dot_radius_m": one.dot_radius_m, "numbers": [one.number, two.number]}
    elif isinstance(one, RoundTarget):
        ends = {"round_radius_m": one.radius_m}
    elif isinstance(one, BallTarget):
        ends = {"ball_diameter_m": one.diameter_m}
    return {"kind": "scale_bar", "length_m": bar.length_m, "sigma_m": bar.sigma_m, **ends}


_MADE: dict[type, Callable[[Any], Document]] = {
    TestField: _field,
    Board: _board,
    Wand: _wand,
    SingleLight: _light,
    LFrame: _l_frame,
    ScaleBar: _scale_bar,
}
