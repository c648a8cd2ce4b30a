"""Tables of the pipeline's stages in scenarios and settings files, made from the stages' settings classes."""

import ast
import inspect
from typing import TYPE_CHECKING, Any, get_type_hints

from pydantic import Field, create_model

from mosca.data.files.toml import Table
from mosca.data.settings import DetectionSettings, MatchSettings, TrackSettings


def settings_table(settings: type, name: str, doc: str) -> type[Table]:
    """Return a table with the keys, bounds and descriptions of a settings class; a key not given is None."""
    hints = get_type_hints(settings, include_extras=True)
    described = attribute_docstrings(settings)
    fields: dict[str, Any] = {
        key: (hint | None, Field(None, description=described.get(key))) for key, hint in hints.items()
    }
    made: type[Table] = create_model(name, __base__=Table, __doc__=doc, **fields)
    return made


def attribute_docstrings(settings: type) -> dict[str, str]:
    """Return the string under each field of a class, on one line."""
    body = ast.parse(inspect.getsource(settings)).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, following in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(following, ast.Expr):
            assert isinstance(field.target, ast.Name)
            assert isinstance(following.value, ast.Constant)
            found[field.target.id] = " ".join(str(following.value.value).split())
    return found


DETECTION = "Settings of target detection that differ from the pipeline's defaults."
MATCH = "Settings of correspondence that differ from the pipeline's defaults."
TRACK = "Settings of tracking that differ from the pipeline's defaults."

if TYPE_CHECKING:  # the tables are made below: a type checker does not need their keys

    class DetectionSpec(Table):
        """See DETECTION."""

    class MatchSpec(Table):
        """See MATCH."""

    class TrackSpec(Table):
        """See TRACK."""

else:
    DetectionSpec = settings_table(DetectionSettings, "DetectionSpec", DETECTION)
    MatchSpec = settings_table(MatchSettings, "MatchSpec", MATCH)
    TrackSpec = settings_table(TrackSettings, "TrackSpec", TRACK)


class StageTables(Table):
    """The tables of all stages."""

    detection: DetectionSpec = DetectionSpec()
    match: MatchSpec = MatchSpec()
    track: TrackSpec = TrackSpec()
