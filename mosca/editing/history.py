"""Files beside an edited file: FILE.edits.toml with edits and digests, FILE.edits.npz with what they changed."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import tomli_w

from mosca.data.arrays import Array
from mosca.data.files.bounded import open_file
from mosca.data.files.npz import from_npz, write_npz_file
from mosca.data.files.whole_file import check_writable, whole_file, write_text
from mosca.data.motion.motion import Motion
from mosca.data.tracks import Tracks
from mosca.editing.edit_file import Edits, HistoryTable
from mosca.editing.record import Change, change, fingerprint, undone
from mosca.errors import InputError

Take = TypeVar("Take", Tracks, Motion)
_OF = "of"


@dataclass(frozen=True)
class Edited(Generic[Take]):
    """A take and its edits, with one ``Change`` for each table of ``edits``; undone from the last one back."""

    take: Take
    source: str
    source_sha256: str
    edits: tuple[dict[str, Any], ...] = ()
    changes: tuple[Change, ...] = ()

    def edited(self, edits: Edits[Take]) -> "Edited[Take]":
        """Return the take with more edits done; InputError as ``Edits.states``."""
        states = edits.states(self.take)
        more: list[Change] = [change(before, after) for before, after in pairwise(states)]
        return Edited(
            states[-1], self.source, self.source_sha256, (*self.edits, *edits.documents), (*self.changes, *more)
        )

    def undone(self, last: int) -> "Edited[Take]":
        """Return the take without the ``last`` edits, bit for bit."""
        take: Any = self.take
        left = len(self.edits) - last
        for one in reversed(self.changes[left:]):
            take = undone(take, one)
        return Edited(take, self.source, self.source_sha256, self.edits[:left], self.changes[:left])


@dataclass(frozen=True)
class TakeFormat(Generic[Take]):
    """Functions that read and write takes of one kind, and read their edits."""

    read: Callable[[Path], Take]
    write: Callable[[Take, Path], None]
    read_edits: Callable[[Path], Edits[Take]]


def sidecars(path: Path) -> tuple[Path, Path]:
    """Return the paths of the edits and of the record beside ``path``."""
    return path.with_name(f"{path.name}.edits.toml"), path.with_name(f"{path.name}.edits.npz")


def read_edited(path: Path, form: TakeFormat[Take]) -> Edited[Take]:
    """Read a take, and the edits beside it where there are any.

    InputError where the take was changed by another program since, or where one of the two files beside it is missing
    or belongs to another take.
    """
    edits_path, record_path = sidecars(path)
    if not (edits_path.exists() or record_path.exists()):
        return Edited(form.read(path), path.name, digest(path))
    edits = form.read_edits(edits_path)
    history: HistoryTable | None = edits.history
    if history is None:
        raise InputError(
            f"{edits_path}: key 'history' is missing; it is no file that 'mosca edit' wrote beside a take"
        )
    if digest(path) != history.sha256:
        raise InputError(
            f"{path}: is not as 'mosca edit' wrote it, by the sha256 in {edits_path.name}; bring that file back, or "
            f"move {edits_path.name} and {record_path.name} away to begin anew"
        )
    take = form.read(path)

    def made(arrays: Mapping[str, Array]) -> Edited[Take]:
        if bytes(arrays[_OF]) != fingerprint(take):
            raise ValueError(f"it is not that of {path.name} as it is read now; give the unit and rate of the edit")
        changes = _split(arrays, 1 + len(edits.documents))
        try:
            last: Any = undone(take, changes[-1])  # restores what the file's format cannot hold
        except IndexError:
            raise ValueError(f"it does not fit {path.name}") from None
        return Edited(last, history.source, history.source_sha256, tuple(edits.documents), changes[:-1])

    return from_npz(record_path, made, "recorded edits", "'mosca edit'")


def write_edited(edited: Edited[Take], path: Path, form: TakeFormat[Take]) -> bool:
    """Write a take with the edits and the record beside it; return whether the file holds it bit for bit.

    Each file is written whole or not at all, the take last. A take without edits has no files beside it.
    """
    edits_path, record_path = sidecars(path)
    for one in (path, edits_path, record_path):
        check_writable(one)
    with whole_file(path) as temporary:
        form.write(edited.take, temporary)
        of = digest(temporary)
        back = form.read(temporary)
        if edited.edits:
            changes = (*edited.changes, change(edited.take, back))
            arrays = {
                f"{k:04d}.{name}": values for k, one in enumerate(changes) for name, values in one.arrays.items()
            }
            with whole_file(record_path) as record:
                write_npz_file(record, {_OF: np.frombuffer(fingerprint(back), np.uint8), **arrays})
            history = {"source": edited.source, "source_sha256": edited.source_sha256, "sha256": of}
            write_text(edits_path, tomli_w.dumps({"history": history, "edit": list(edited.edits)}))
        else:
            for one in (edits_path, record_path):
                one.unlink(missing_ok=True)
    return fingerprint(back) == fingerprint(edited.take)


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; InputError where it cannot be read."""
    try:
        with open_file(path) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}; a take is wanted") from None


def _split(arrays: Mapping[str, Array], n: int) -> tuple[Change, ...]:
    """Return the changes of n edits from the arrays of a record; ValueError where their number is not n."""
    parts: list[dict[str, Array]] = [{} for _ in range(n)]
    for name in arrays:
        number, _, rest = name.partition(".")
        if name == _OF:
            continue
        if not number.isdecimal() or int(number) >= n:
            raise ValueError(f"'{name}' is of no edit in the file beside it")
        parts[int(number)][rest] = arrays[name]
    if not all(parts):
        raise ValueError(f"{sum(map(bool, parts))} edits are recorded, {n} are wanted")
    return tuple(map(Change, parts))
