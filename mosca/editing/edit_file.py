"""The TOML file of edits: operations in the order in which they are done, each a table of its own.

::

    [[edit]]
    trim = { frames = [120, 480] }

    [[edit]]
    swap = { labels = ["LKNE", "RKNE"], frames = [200, 230] }

A new operation needs a frozen dataclass with ``apply``, and a line in TRACK_OPERATIONS or MOTION_OPERATIONS.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeVar

from pydantic import BaseModel, Field, create_model, model_validator

from mosca.data.files.toml import Table, check, read_toml
from mosca.data.motion.motion import Motion
from mosca.data.tracks import Tracks
from mosca.editing.fill_gaps import FillGaps
from mosca.editing.foot_lock import FootLock
from mosca.editing.marker_operations import (
    DeleteSamples,
    FilterTracks,
    OffsetMarkers,
    RenameMarkers,
    SwapLabels,
    TrimTracks,
)
from mosca.editing.motion_operations import FilterMotion, RotateJoint, TrimMotion
from mosca.editing.operation import EditError, Operation
from mosca.editing.retarget import Retarget
from mosca.errors import InputError

TRACK_OPERATIONS: Mapping[str, type[Operation[Tracks]]] = {
    "trim": TrimTracks,
    "swap": SwapLabels,
    "rename": RenameMarkers,
    "fill": FillGaps,
    "filter": FilterTracks,
    "offset": OffsetMarkers,
    "delete": DeleteSamples,
}
MOTION_OPERATIONS: Mapping[str, type[Operation[Motion]]] = {
    "trim": TrimMotion,
    "filter": FilterMotion,
    "rotate": RotateJoint,
    "foot_lock": FootLock,
    "retarget": Retarget,
}
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$", description="SHA-256 of a file, 64 hexadecimal digits")]
Take = TypeVar("Take", Tracks, Motion)


class HistoryTable(Table):
    """What ``mosca edit`` adds to the edits that it keeps beside its output."""

    source: str = Field(description="name of the file that was edited first")
    source_sha256: Sha256
    sha256: Sha256 = Field(description="of the edited file; it must not have changed since")


class _OneEdit(Table):
    @model_validator(mode="after")
    def _one(self) -> "_OneEdit":
        if len(self.model_fields_set) != 1:
            raise ValueError(f"{len(self.model_fields_set)} operations stand in one [[edit]]; 1 is wanted")
        return self


class _Edits(Table):
    FILE_KIND: ClassVar[str] = "edits"


class Edits(Generic[Take]):
    """Operations in their order, each with its name and its table in the file."""

    def __init__(self, path: Path, document: Mapping[str, Any], model: BaseModel) -> None:
        self.path = path
        self.history: HistoryTable | None = model.history  # type: ignore[attr-defined]
        self.documents: list[dict[str, Any]] = list(document["edit"])
        self.names: list[str] = [next(iter(one)) for one in self.documents]
        tables = model.edit  # type: ignore[attr-defined]
        self.operations: list[Operation[Take]] = [getattr(t, n) for t, n in zip(tables, self.names, strict=True)]

    def states(self, take: Take) -> list[Take]:
        """Return the take before the first edit, and after each. InputError names file, edit, key and value."""
        states = [take]
        for k, (name, operation) in enumerate(zip(self.names, self.operations, strict=True)):
            where = f"{self.path}: key 'edit[{k}].{name}"
            if not _length(states[-1]):
                raise InputError(f"{where}': no sample is left to edit; take edits before it out")
            try:
                states.append(operation.apply(states[-1]))
            except EditError as error:
                raise InputError(f"{where}.{error.key}': {error}") from None
        return states


def read_track_edits(path: Path) -> Edits[Tracks]:
    """Read edits of tracks. InputError names file, key, value and what is allowed."""
    return _read(path, TRACK_OPERATIONS)


def read_motion_edits(path: Path) -> Edits[Motion]:
    """Read edits of a motion; files named in them are relative to the folder of ``path``. InputError as above."""
    edits: Edits[Motion] = _read(path, MOTION_OPERATIONS)
    edits.operations = [
        one.within(Path(path).parent) if isinstance(one, Retarget) else one for one in edits.operations
    ]
    return edits


def _read(path: Path, operations: Mapping[str, type[Any]]) -> Edits[Any]:
    document = read_toml(path)
    return Edits(path, document, check(_model(tuple(operations.items())), document, path))


@cache
def _model(operations: tuple[tuple[str, type[Any]], ...]) -> type[BaseModel]:
    """Return the model of a file of these operations."""
    one: Any = create_model("_OneEdit", __base__=_OneEdit, **{n: (c, None) for n, c in operations})  # type: ignore[call-overload]
    many = Annotated[tuple[one, ...], Field(min_length=1, description="[[edit]] tables, in order")]
    history: Any = (HistoryTable | None, None)
    made: type[BaseModel] = create_model("_Edits", __base__=_Edits, edit=(many, ...), history=history)
    return made


def _length(take: Tracks | Motion) -> int:
    return len(take) if isinstance(take, Tracks) else len(take.root_xyz)
