"""Record of the changes of an edit, from which the state before it is restored bit for bit.

A take is a table of rows; the rows of a motion are its root's position and each joint's quaternion, frame by frame.
For each row before the edit, the record holds the index of the identical row after it, or, without one, the row
itself. So it works for any operation, and unchanged rows take almost no space.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.data.motion.motion import Motion, Skeleton
from mosca.data.tracks import Tracks

Arrays = Mapping[str, Array]
_ROW, _HEAD, _SAME = "row.", "head.", "same"


@dataclass(frozen=True)
class Change:
    """Change from a state back to the one before it, as named arrays that a file can hold."""

    arrays: Arrays

    @property
    def rows(self) -> int:
        """Number of rows before the edit that are missing after it: changed or removed."""
        return next(len(values) for name, values in self.arrays.items() if name.startswith(_ROW))


def change(before: Tracks | Motion, after: Tracks | Motion) -> Change:
    """Return the change from ``after`` back to ``before``."""
    heads, rows = _table(before)
    own, other = _as_bytes(rows, _table(after)[1])
    place = {one: k for k, one in enumerate(other)}
    same = np.array([place.get(one, -1) for one in own], np.int64)
    kept = {_ROW + name: values[same < 0] for name, values in rows.items()}
    # differences: successive rows become ones, which compress to almost nothing
    return Change({_SAME: np.diff(same, prepend=0), **kept, **{_HEAD + n: v for n, v in heads.items()}})


def undone(after: Tracks | Motion, made: Change) -> Tracks | Motion:
    """Return the state before an edit. Raises KeyError, IndexError or ValueError where the two do not match."""
    same = np.cumsum(made.arrays[_SAME])
    there = _table(after)[1]
    rows = {}
    for name, kept in ((n.removeprefix(_ROW), v) for n, v in made.arrays.items() if n.startswith(_ROW)):
        rows[name] = np.empty((len(same), *kept.shape[1:]), kept.dtype)
        rows[name][same >= 0] = there[name][same[same >= 0]]
        rows[name][same < 0] = kept
    heads = {n.removeprefix(_HEAD): v for n, v in made.arrays.items() if n.startswith(_HEAD)}
    return _take(heads, rows)


def fingerprint(take: Tracks | Motion) -> bytes:
    """Return a digest (SHA-256) of the whole contents of a take: takes with equal digests are equal bit for bit."""
    total = hashlib.sha256()
    for part in _table(take):
        for name, values in part.items():
            total.update(f"{name}\0{values.dtype.str}\0{values.shape}\0".encode())
            total.update(np.ascontiguousarray(values).tobytes())
    return total.digest()


def _table(take: Tracks | Motion) -> tuple[Arrays, Arrays]:
    """Return the data that a take holds once, and its rows as columns (n, ...)."""
    if isinstance(take, Tracks):
        return {}, {name: getattr(take, name) for name in Tracks.__dataclass_fields__}
    places = np.concatenate([take.root_xyz, np.zeros((len(take.root_xyz), 1))], axis=1)
    values = np.concatenate([places[:, None], take.rotations], axis=1)
    own = take.skeleton
    heads = {
        "rate": np.array(take.frame_rate_hz), "names": np.array(own.names), "parents": own.parents,
        "offsets": own.offsets, "orders": np.array(own.orders),
    }  # fmt: skip
    return heads, {"values": values.reshape(-1, 4)}


def _take(heads: Arrays, rows: Arrays) -> Tracks | Motion:
    if "values" not in rows:
        return Tracks(**rows)
    skeleton = Skeleton(
        tuple(heads["names"].tolist()), heads["parents"], heads["offsets"], tuple(heads["orders"].tolist())
    )
    values = rows["values"].reshape(-1, 1 + len(skeleton.names), 4)
    return Motion(skeleton, float(heads["rate"]), values[:, 0, :3], values[:, 1:])


def _as_bytes(one: Arrays, other: Arrays) -> tuple[list[bytes], list[bytes]]:
    """Return each row of two tables of the same columns as bytes, texts of both padded to the longer length."""
    kinds = {name: np.result_type(one[name], other[name]) for name in one}
    packed = []
    for rows in (one, other):
        columns = [
            np.ascontiguousarray(rows[name], kind).reshape(len(rows[name]), int(np.prod(rows[name].shape[1:])))
            for name, kind in kinds.items()
        ]
        joined = np.concatenate([c.view(np.uint8) for c in columns], axis=1)
        packed.append([row.tobytes() for row in np.ascontiguousarray(joined)])
    return packed[0], packed[1]
