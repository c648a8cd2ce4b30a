"""Kind of a TOML document of the project, by its keys: an error can name a file given in another one's place."""

from collections.abc import Mapping
from typing import Any

KINDS = {
    "scenario": ("a scenario", "a scenario goes to mosca run and has [scene] and [limits]"),
    "claim": ("a claim file", "a claim file goes to mosca claim and has 'scenario' and [[claim]]"),
    "acceptance": (
        "an acceptance file",
        "an acceptance file goes to mosca accept --artefact and has [volume], [[bar]] and [[line]], or [clusters]",
    ),
    "rig": ("a rig file", "a rig file goes to --rig and has a [[camera]] table a camera"),
    "target": ("a target file", "a target file goes to mosca calibrate --target and has a key 'kind'"),
    "bodies": ("a bodies file", 'a bodies file goes to mosca bodies find and has kind = "bodies"'),
    "marker-model": ("a marker model", 'a marker model goes to --model or --labels and has kind = "marker-model"'),
    "marker-template": (
        "a marker template",
        'a marker template goes to mosca labels auto --set and has kind = "marker-template"',
    ),
    "surface-model": (
        "a surface model",
        'a surface model goes to mosca labels auto --set and has kind = "surface-model"',
    ),
    "lamps": ("a lamp file", "a lamp file goes to --worn and has bit_s, known and [[lamp]]"),
    "program": ("a program", "a program goes to capture --program and has [[target]], [[event]] and [[program]]"),
    "plan": (
        "a plan file",
        "a plan file goes to mosca plan and has [volume], [budget] and [[camera]] to choose from",
    ),
    "edits": ("a file of edits", "a file of edits goes to mosca edit and has [[edit]] tables"),
    "lab": ("a lab file", "a lab file goes to mosca run --lab and has [[camera]], [[estimate]] and [[not_told]]"),
    "settings": ("a settings file", "a settings file goes to --settings and has [detection], [match] or [track]"),
}
"""Kind -> what the file is, and a text that states where it goes and by what it is recognised."""


def file_kind(document: Mapping[str, Any]) -> str:
    """Return the kind of file that ``document`` is, a key of KINDS; "" where its keys fit none."""
    keys, kind = set(document), document.get("kind")
    if keys & {"scene", "working_space"}:
        return "scenario"
    if isinstance(kind, str):
        return kind if kind in ("bodies", "marker-model", "marker-template", "surface-model") else "target"
    for name, marks in (
        ("claim", {"claim", "vary"}),
        ("acceptance", {"bar", "length_error", "clusters"}),
        ("plan", {"budget", "rail", "room"}),
        ("lamps", {"bit_s", "lamp"}),
        ("program", {"program", "target", "event"}),
        ("edits", {"edit"}),
        ("lab", {"estimate", "not_told"}),
        ("rig", {"camera"} if _has_rig_cameras(document) else set()),
        ("settings", {"detection", "match", "track", "background", "volume", "assembly"}),
    ):
        if keys & marks:
            return name
    return ""


def _has_rig_cameras(document: Mapping[str, Any]) -> bool:
    """Return whether a camera's lens is a table; in a target of measured points it is a name."""
    cameras = document.get("camera")
    return isinstance(cameras, list) and any(
        isinstance(c, Mapping) and isinstance(c.get("lens"), Mapping) for c in cameras
    )


def other_kind(document: Mapping[str, Any], wanted: str) -> str:
    """Return a text that ``document`` is another kind of file than ``wanted``; "" where it is not, or is unknown."""
    found = file_kind(document)
    if not wanted or found in ("", wanted):
        return ""
    (is_a, goes), (wants_a, wanted_goes) = KINDS[found], KINDS[wanted]
    return f"is {is_a}, not {wants_a}; {goes}; {wanted_goes}"
