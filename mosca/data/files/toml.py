"""TOML files checked against a pydantic model; one line of text names what is wrong and what is allowed.

Tables are ``Table`` or pydantic dataclasses with ``SETTINGS``: errors read the same for both.
"""

import difflib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from mosca.data.files.bounded import MOST_DEPTH, MOST_TEXT_BYTES, open_file
from mosca.data.files.file_kind import other_kind
from mosca.errors import InputError

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
SETTINGS = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)
"""Configuration of pydantic dataclasses that are both the settings of a stage and a TOML table."""
MISSING = ("missing", "union_tag_not_found")
UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
"""Pydantic's errors for an unknown key of a model or a dataclass."""

_PART = r"(?:[A-Za-z0-9_-]++|\"[^\"\n]*+\"|'[^'\n]*+')\s*+\.\s*+"
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-])(?:{_PART}){{{MOST_DEPTH}}}")
_TOO_DEEP = f"lists and tables stand more than {MOST_DEPTH} deep inside each other; flatten them"
_TOO_LARGE = "an integer has more than 64 bits; give a smaller one"


class UnboundedTomlError(tomllib.TOMLDecodeError):
    """TOML that is nested too deeply, or holds an integer that is too large."""


class Table(BaseModel):
    """A TOML table: frozen; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    FILE_KIND: ClassVar[str] = ""
    """For the table of a whole file: its key in ``file_kind.KINDS``."""


T = TypeVar("T", bound=BaseModel)


def described(schema: dict[str, Any]) -> dict[str, Any]:
    """Return a JSON schema in which keys that hold tables are described by the first sentence of their table.

    A key with a single allowed value, which names the kind of its table, is described by its own table's sentence.
    Keys that have a description keep it; ``schema`` is changed.
    """
    tables = schema.get("$defs", {})
    for table in (schema, *tables.values()):
        for key in table.get("properties", {}).values():
            meant = table if "const" in key else tables.get(_table_of(key), {})
            text = " ".join(meant.get("description", "").split("\n\n")[0].split())
            if "description" not in key and text:
                key["description"] = text.split(". ")[0].rstrip(".") + "."
    return schema


def _table_of(key: Any) -> str:
    """Return the name of the table that a key, or each element of its list, is; "" for none or a choice."""
    if "$ref" in key:
        return str(key["$ref"]).rsplit("/", 1)[-1]
    found = [_table_of(one) for one in key.get("anyOf", ())] + [
        _table_of(key[name]) for name in ("items",) if name in key
    ]
    tables = [name for name in found if name]
    return tables[0] if len(tables) == 1 else ""


def read_toml(path: Path) -> dict[str, Any]:
    """Return the TOML document at ``path``; InputError where it is missing or not TOML."""
    try:
        with open_file(path, MOST_TEXT_BYTES) as file:
            return parse_toml(file.read().decode("utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file{_similar_files(path)}") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; a TOML file is wanted") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return the TOML document ``text``; TOMLDecodeError where it is not TOML, UnboundedTomlError where too deep.

    TOML's integers have 64 bits, and its line ends are LF or CRLF.
    """
    # each part of a dotted key is a table in the one before; tomllib's time grows with the square of their number
    if _LONG_KEY.search(text):
        raise UnboundedTomlError(f"a key has more than {MOST_DEPTH} parts; give it fewer")
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise UnboundedTomlError(_TOO_DEEP) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # Python's own limit to the digits of an integer
        raise UnboundedTomlError(_TOO_LARGE) from None
    level: list[Any] = [document]
    for _ in range(MOST_DEPTH + 1):
        if any(type(value) is int and not -(1 << 63) <= value < 1 << 63 for value in level):
            raise UnboundedTomlError(_TOO_LARGE)
        lists = [value for value in level if isinstance(value, list)]
        tables = [value.values() for value in level if isinstance(value, dict)]
        level = [inner for value in (*lists, *tables) for inner in value]
    if level:
        raise UnboundedTomlError(_TOO_DEEP)
    return document


def check(model: type[T], document: dict[str, Any], where: str | Path) -> T:
    """Return ``document`` as ``model``; InputError names file, key, value and what is allowed."""
    try:
        checked = model.model_validate(document)
    except ValidationError as error:
        other = other_kind(document, getattr(model, "FILE_KIND", ""))
        raise InputError(f"{where}: {other or _first_line(model, error)}") from None
    found = _truth_value_as_number(document, checked, ())
    if found is not None:
        place, given = found
        raise InputError(f"{where}: key '{_dotted(place)}': {str(given).lower()} given; a number is wanted")
    return checked


def _truth_value_as_number(
    given: Any, checked: Any, place: tuple[int | str, ...]
) -> tuple[tuple[int | str, ...], bool] | None:
    """Return where pydantic silently took a true or false for 1 or 0, and the value; None where it did not."""
    if isinstance(given, bool):
        return (place, given) if isinstance(checked, int | float) and not isinstance(checked, bool) else None
    pairs: list[tuple[int | str, Any, Any]] = []
    if isinstance(given, dict):
        inside = checked if isinstance(checked, Mapping) else getattr(checked, "__dict__", {})
        pairs = [(key, one, inside.get(key)) for key, one in given.items()]
    elif isinstance(given, list) and isinstance(checked, list | tuple) and len(given) == len(checked):
        pairs = [(k, a, b) for k, (a, b) in enumerate(zip(given, checked, strict=True))]
    return next(filter(None, (_truth_value_as_number(one, own, (*place, key)) for key, one, own in pairs)), None)


_NUMBER, _WHOLE, _TRUTH, _TEXT = "a number", "a whole number", "true or false", "a text"
_WANTED = {
    **dict.fromkeys(("float_type", "float_parsing"), _NUMBER),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float", "int_parsing_size"), _WHOLE),
    **dict.fromkeys(("bool_type", "bool_parsing"), _TRUTH),
    **dict.fromkeys(("string_type", "string_unicode"), _TEXT),
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type", "dataclass_type"), "a table"),
    **dict.fromkeys(("tuple_type", "list_type", "iterable_type"), "a list in [ ]"),
    **dict.fromkeys(("path_type",), "the name of a file, a text"),
    "finite_number": "a finite number",
    "none_required": "nothing",
    "greater_than": "a number greater than {gt}",
    "greater_than_equal": "a number greater than or equal to {ge}",
    "less_than": "a number less than {lt}",
    "less_than_equal": "a number less than or equal to {le}",
    "multiple_of": "a multiple of {multiple_of}",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "union_tag_invalid": "one of {expected_tags}",
    "string_too_short": "a text of {min_length} characters or more",
    "string_too_long": "a text of {max_length} characters at most",
    "string_pattern_mismatch": "a text of the pattern {pattern}",
    "too_short": "a list of {min_length} or more",
    "too_long": "a list of {max_length} at most",
}
"""What is wanted, by pydantic's type of error and with its values; pydantic's own texts are for programmers."""
_BRANCHES = ("float", "int", "str", "bool", "constrained-str", "constrained-float", "constrained-int")
_WRONG_JSON = ("json_invalid", "json_type")


def in_words(error: Mapping[str, Any]) -> str:
    """Return in this project's words what one of the ``errors()`` of a pydantic ValidationError reports."""
    kind, values = error["type"], error.get("ctx", {})
    if kind in ("value_error", "assertion_error"):
        return str(values["error"])
    if kind in _WRONG_JSON:
        return "is no JSON"
    if kind in MISSING:
        return "is missing"
    if kind in UNKNOWN_KEY:
        return "is not known"
    if kind in _WANTED:
        return f"{_WANTED[kind].format(**values)} is wanted"
    return str(values["message"]) if "message" in values else f"a value of another kind is wanted ({kind})"


def _similar_files(path: Path) -> str:
    folder = path.parent
    if not folder.is_dir():
        return f" (and no folder {folder})"
    near = difflib.get_close_matches(path.name, [p.name for p in folder.iterdir()], n=1)
    return f"; did you mean '{folder / near[0]}'?" if near else ""


def _first_line(model: type[BaseModel], error: ValidationError) -> str:
    # a misspelt key is both unknown and missing: the unknown one is more helpful
    errors: list[Mapping[str, Any]] = sorted(error.errors(), key=lambda e: e["type"] not in UNKNOWN_KEY)
    first, more = errors[0], len(errors) - 1
    first = _at_its_tag(first)
    place = _dotted(first["loc"])
    if first["type"] in UNKNOWN_KEY:
        allowed = _keys_at(model, first["loc"][:-1])
        key = str(first["loc"][-1])
        near = difflib.get_close_matches(key, allowed, n=1)
        text = f"unknown key '{place}'"
        text += f"; did you mean '{near[0]}'?" if near else "."
        text += f" Allowed here: {', '.join(allowed)}" if allowed else ""
    elif first["type"] in MISSING:
        text = f"key '{place}' is missing; {_described(model, first['loc'])}add it"
    else:
        given = repr(first.get("input"))
        same = [in_words(e) for e in errors if _dotted(_at_its_tag(e)["loc"]) == place]
        text, more = " or ".join(dict.fromkeys(same)), len(errors) - len(same)
        text = text.replace(" is wanted or ", " or ")
        if first["type"] == "string_pattern_mismatch":
            text = f"{_described(model, first['loc'])}is wanted"
        if place:  # an error of the table as a whole has no key
            text = f"key '{place}': {given if len(given) < 60 else given[:57] + '...'} given; {text}"
    return text + (f" (and {more} more)" if more else "")


def _at_its_tag(error: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the error; where a union's tag is wrong or missing, located at the key of the tag."""
    if error["type"] not in ("union_tag_invalid", "union_tag_not_found"):
        return error
    values = error["ctx"]
    return {**error, "loc": (*error["loc"], values["discriminator"].strip("'")), "input": values.get("tag")}


def _dotted(location: tuple[int | str, ...]) -> str:
    text = ""
    for part in location:
        if part in _BRANCHES or (isinstance(part, str) and re.search(r"[\[\]]", part)):
            continue  # pydantic's name of a type that was tried
        text += f"[{part}]" if isinstance(part, int) else (f".{part}" if text else str(part))
    return text


def _model_at(model: type, location: tuple[int | str, ...]) -> list[type]:
    """Return the models that are allowed at ``location`` (several where a union has no tag yet)."""
    here: list[type] = [model]
    for part in location:
        nexts: list[type] = []
        for candidate in here:
            if isinstance(part, str) and part in _fields(candidate):
                nexts += _models_in(_fields(candidate)[part].annotation)
            elif isinstance(part, int) or any(_tag_of(candidate) == part for _ in (0,)):
                nexts.append(candidate)
        here = nexts or [m for m in here if _tag_of(m) == part] or here
    return here


def _fields(model: type) -> dict[str, FieldInfo]:
    """Return the fields of a model or of a pydantic dataclass."""
    return getattr(model, "__pydantic_fields__", {})


def _tag_of(model: type) -> Any:
    for key in ("kind", "model"):
        if key in _fields(model):
            values = get_args(_fields(model)[key].annotation)
            if values:
                return values[0]
    return None


def _models_in(annotation: Any) -> list[type]:
    if isinstance(annotation, type) and _fields(annotation):
        return [annotation]
    return [m for arg in get_args(annotation) for m in _models_in(arg)]


def _keys_at(model: type, location: tuple[int | str, ...]) -> list[str]:
    tags = [part for part in location if isinstance(part, str)]
    models = _model_at(model, location)
    tagged = [m for m in models if tags and _tag_of(m) == tags[-1]]
    return sorted({name for m in (tagged or models) for name in _fields(m)})


def _described(model: type, location: tuple[int | str, ...]) -> str:
    for candidate in _model_at(model, location[:-1]):
        field = _fields(candidate).get(str(location[-1]))
        if field is not None and field.description:
            return f"({field.description}) "
    return ""
