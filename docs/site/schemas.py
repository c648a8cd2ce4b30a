"""Pages of the files' keys, made from the JSON schemas that ``mosca schema`` prints."""

import json
from typing import Any

from markdown_text import cell

from mosca.accuracy.acceptance.artefact import acceptance_schema
from mosca.data.files.rig_file import rig_schema
from mosca.data.files.target_file import target_schema
from mosca.formats.bodies.model_file import model_schema
from scenarios.spec.claim import claim_schema
from scenarios.spec.plan import plan_schema
from scenarios.spec.scenario import scenario_schema

Schema = dict[str, Any]
METRICS = ("limits", "breaks")
"""Tables whose keys are metrics: they stand on the page of metrics."""


def pages() -> dict[str, str]:
    """Return the pages of all files that have a schema (uri -> Markdown)."""
    return {
        "reference/scenario.md": _page(
            "Scenario files",
            "A scenario is one TOML file: what moves, which cameras film it, what is disturbed, and which limits "
            "must hold. `mosca new FILE.toml` writes a commented one, with the schema beside it by which editors "
            "complete keys; `mosca schema scenario` prints it. Keys that are left out have the default.",
            scenario_schema(),
        ),
        "reference/claim.md": _page(
            "Claim files",
            "What is claimed of many runs of a scenario, and what varies from run to run ([Claims](../claims.md)). "
            "Schema: `mosca schema claim`.",
            claim_schema(),
        ),
        "reference/acceptance.md": _page(
            "Acceptance files",
            "Artefacts with their certificates, how they were shown, and what is permitted "
            "([Acceptance tests](../acceptance.md)). Schema: `mosca schema acceptance`.",
            acceptance_schema(),
        ),
        "reference/plan.md": _page(
            "Plan files",
            "A volume, a room and cameras on sale, for which places are looked for ([Planner](../planner.md)). "
            "Schema: `mosca schema plan`.",
            plan_schema(),
        ),
        "reference/rig.md": _page(
            "Rig files",
            "The calibrated cameras. `mosca calibrate` writes such a file, `mosca rig check` reads it, "
            "`mosca rig convert` makes it from files of other programs. Schema: `mosca schema rig`.",
            rig_schema(),
        ),
        "reference/target.md": _page(
            "Target files",
            "What is put before the cameras for calibration ([Calibrate](../calibration.md)). "
            "Schema: `mosca schema target`.",
            target_schema(),
        ),
        "reference/marker_model.md": _page(
            "Marker-model files",
            "What `mosca labels` learns of a subject ([Names and bodies](../identity.md)). "
            "Schema: `mosca schema marker-model`.",
            model_schema(),
        ),
    }


def _page(title: str, words: str, schema: Schema) -> str:
    definitions = schema.get("$defs", {})
    text = [f"# {title}\n", f"{words}\n"]
    shown: list[str] = []
    if "oneOf" in schema:
        for one in _referred(schema):
            text += _table(_heading(definitions[one]), definitions[one], 2)
            shown += _below(definitions[one])
    else:
        text += _table("At the top", schema, 2)
        for key, one in schema["properties"].items():
            shown += [name for name in _below({"properties": {key: one}}) if name not in shown]
    done: set[str] = set()
    while shown:
        name = shown.pop(0)
        if name not in done:
            done.add(name)
            text += _table(name, definitions[name], 2, key=_key(schema, name))
            shown += _below(definitions[name])
    return "\n".join(text)


def _heading(definition: Schema) -> str:
    """Return the title of one of several kinds of file: its kind."""
    kind = definition.get("properties", {}).get("kind", {}).get("const")
    return f'kind = "{kind}"' if kind else str(definition["title"])


def _key(schema: Schema, name: str) -> str:
    """Return how a table is written in the file: ``[cameras]``, ``[[camera]]``, ``[scene] kind = "own"``."""
    for key, one in schema.get("properties", {}).items():
        if name in _referred(one):
            written = f"[[{key}]]" if one.get("type") == "array" else f"[{key}]"
            kind = schema["$defs"][name].get("properties", {}).get("kind", {}).get("const")
            several = len(_referred(one)) > 1
            return f'{written} kind = "{kind}"' if several and kind else written
    return ""


def _referred(schema: Any) -> list[str]:
    """Return the names of the definitions that a schema refers to, in order, without looking into them."""
    if isinstance(schema, list):
        return [name for one in schema for name in _referred(one)]
    if not isinstance(schema, dict):
        return []
    found = [schema["$ref"].rsplit("/", 1)[1]] if "$ref" in schema else []
    return found + [
        name for key, one in schema.items() if key not in ("discriminator", "default") for name in _referred(one)
    ]


def _below(definition: Schema) -> list[str]:
    return list(dict.fromkeys(name for one in definition.get("properties", {}).values() for name in _referred(one)))


def _table(title: str, definition: Schema, level: int, key: str = "") -> list[str]:
    """Return a section: heading, description, and a row for each key."""
    anchor = f" {{ #{title} }}" if key or title.isidentifier() else ""
    lines = [f"{'#' * level} {_code(key) if key else title}{anchor}\n"]
    if words := definition.get("description"):
        lines.append(f"{words}\n")
    rows = [
        _row(name, one, name in definition.get("required", ()))
        for name, one in definition.get("properties", {}).items()
    ]
    if rows:
        lines += ["| key | type and range | default | meaning |", "|---|---|---|---|", *rows, ""]
    return lines


def _row(name: str, one: Schema, required: bool) -> str:
    default = "*required*" if required else _default(one)
    kind = "a limit for each [metric](metrics.md)" if name in METRICS else _type(one)
    words = str(one.get("description", "")).split(";")[0] if name in METRICS else str(one.get("description", ""))
    return f"| `{name}` | {kind} | {default} | {cell(' '.join(words.replace('``', '`').split()))} |"


def _default(one: Schema) -> str:
    value = one.get("default")
    if value is None or isinstance(value, dict) or (_referred(one) and isinstance(value, list) and value):
        return ""
    return _code(json.dumps(value, ensure_ascii=False))


def _type(one: Schema) -> str:
    """Return type and range in words, with links to tables."""
    if "$ref" in one:
        name = one["$ref"].rsplit("/", 1)[1]
        return f"[table](#{name})"
    if kinds := one.get("discriminator", {}).get("mapping"):
        tables = ", ".join(f"[{kind}](#{ref.rsplit('/', 1)[1]})" for kind, ref in kinds.items())
        return f"table by its kind: {tables}"
    for joined in ("anyOf", "oneOf"):
        if joined in one:
            kinds = [_type(choice) for choice in one[joined] if choice.get("type") != "null"]
            return " or ".join(dict.fromkeys(kinds))
    if "enum" in one:
        return " \\| ".join(_code(json.dumps(value)) for value in one["enum"])
    if "const" in one:
        return _code(json.dumps(one["const"]))
    if one.get("type") == "array":
        return _array(one)
    return f"{one.get('type', 'any')}{_bounds(one)}"


def _array(one: Schema) -> str:
    if items := one.get("prefixItems"):
        return f"[{', '.join(_type(item) for item in items)}]"
    least, most = one.get("minItems"), one.get("maxItems")
    number = "" if least is None and most is None else f", {least or 0} to {most}" if most else f", {least} or more"
    return f"list of {_type(one.get('items', {}))}{number}"


def _bounds(one: Schema) -> str:
    signs = (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤"))
    found = [f"{sign} {one[key]:g}" for key, sign in signs if key in one]
    return f" {', '.join(found)}" if found else ""


def _code(text: str) -> str:
    return cell(f"`{text}`")
