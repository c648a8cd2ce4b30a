"""Common parts of operations: errors, stretches of frames, markers by their names, keyframes with blends."""

import difflib
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Literal, Protocol, TypeVar

import numpy as np
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from mosca.data.arrays import Array
from mosca.data.files.toml import SETTINGS
from mosca.data.motion.motion import LARGEST_NUMBER
from mosca.data.tracks import Tracks
from mosca.errors import InputError

Frames = tuple[int, int]
"""First and last frame, both included."""
Labels = Annotated[tuple[str, ...], Field(min_length=1)]
_Bounded = Annotated[float, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
BoundedVector = tuple[_Bounded, _Bounded, _Bounded]
Blend = Literal["smooth", "linear", "step"]
Take = TypeVar("Take")


class EditError(InputError):
    """An operation that cannot be done: its ``key``, and a text with the given value and what is allowed."""

    def __init__(self, key: str, text: object) -> None:
        super().__init__(text)
        self.key = key


class Operation(Protocol[Take]):
    """One operation of an edit file: a frozen dataclass whose fields are the keys of its table."""

    def apply(self, take: Take) -> Take:
        """Return the edited take; the given take is not changed. Raises EditError where this is impossible."""


@dataclass(frozen=True, config=SETTINGS)
class OffsetKeyframe:
    """An offset in the world at a frame."""

    frame: int
    xyz_m: BoundedVector


@dataclass(frozen=True, config=SETTINGS)
class RotationKeyframe:
    """A rotation at a frame: rotation vector in the joint's own axes [deg]."""

    frame: int
    rotation_vector_deg: BoundedVector


Key = TypeVar("Key", OffsetKeyframe, RotationKeyframe)


def _rising(keyframes: tuple[Key, ...]) -> tuple[Key, ...]:
    frames = [one.frame for one in keyframes]
    for a, b in pairwise(frames):
        if b <= a:
            raise ValueError(f"frame {b} follows frame {a}; keyframes in rising order, one a frame, are wanted")
    return keyframes


OffsetKeyframes = Annotated[tuple[OffsetKeyframe, ...], Field(min_length=1), AfterValidator(_rising)]
RotationKeyframes = Annotated[tuple[RotationKeyframe, ...], Field(min_length=1), AfterValidator(_rising)]


def between_keyframes(
    frame: Array, keyframes: Sequence[OffsetKeyframe] | Sequence[RotationKeyframe], blend: Blend
) -> Array:
    """Return values (n, 3) at ``frame`` (n,): blended between keyframes, held before the first and after the last.

    With u the share of the time from one keyframe to the next, the share of the change is u for ``linear``,
    3 u^2 - 2 u^3 for ``smooth`` (at rest at both ends), and 0 until the next for ``step``. EditError where a keyframe
    is not among the frames.
    """
    at = np.array([one.frame for one in keyframes])
    values = np.array(
        [one.xyz_m if isinstance(one, OffsetKeyframe) else one.rotation_vector_deg for one in keyframes], float
    )
    outside = at[(at < frame.min()) | (at > frame.max())]
    if len(outside):
        raise EditError(
            "keyframes", f"frame {outside[0]} given; frames from {frame.min()} to {frame.max()} are wanted"
        )
    before = np.clip(np.searchsorted(at, frame, side="right") - 1, 0, len(at) - 1)
    after = np.minimum(before + 1, len(at) - 1)
    share = np.clip((frame - at[before]) / np.maximum(at[after] - at[before], 1), 0.0, 1.0)
    result: Array = values[before] + (values[after] - values[before]) * eased(share, blend)[:, None]
    return result


def eased(share: Array, blend: Blend) -> Array:
    """Return the share (n,) of a change that is done after a ``share`` (n,) of its time, both from 0 to 1."""
    if blend == "step":
        return np.floor(share)
    return share * share * (3.0 - 2.0 * share) if blend == "smooth" else share


def rows_between(frame: Array, given: Frames | None, key: str = "frames") -> Array:
    """Return the mask of the rows whose ``frame`` (n,) is in ``given``; all for None. EditError out of range."""
    if given is None:
        return np.ones(len(frame), bool)
    first, last = int(frame.min()), int(frame.max())
    if not first <= given[0] <= given[1] <= last:
        raise EditError(
            key, f"[{given[0]}, {given[1]}] given; a first and a last frame from {first} to {last} are wanted"
        )
    return np.asarray((frame >= given[0]) & (frame <= given[1]))


def marker_names(tracks: Tracks) -> list[str]:
    """Return the names of all markers: labels, and ``#TRACK`` for the samples of a track without a label."""
    labels = dict.fromkeys(tracks.label[tracks.label != ""].tolist())
    return [*labels, *(f"#{number}" for number in np.unique(tracks.track[tracks.label == ""]).tolist())]


def rows_of(tracks: Tracks, name: str, key: str = "labels") -> Array:
    """Return the mask of the samples of a marker, one of ``marker_names``; EditError suggests similar names.

    The subject before a colon may be left out where the rest is unique: LKNE for Walker:LKNE.
    """
    known = marker_names(tracks)
    full = [one for one in known if one == name] or [one for one in known if one.endswith(f":{name}")]
    if len(full) == 1:
        if full[0].startswith("#") and full[0] not in tracks.label:
            return np.asarray((tracks.label == "") & (tracks.track == int(full[0][1:])))
        return np.asarray(tracks.label == full[0])
    raise EditError(key, unknown_name(name, known, "marker") if not full else f"'{name}' is {' and '.join(full)}")


def unknown_name(name: str, known: Sequence[str], what: str) -> str:
    """Return a text that ``name`` is unknown, with similar known names or, without any, the first known ones."""
    short = {one.rpartition(":")[2]: one for one in reversed(known)}
    near = dict.fromkeys(short[one] for one in difflib.get_close_matches(name, list(short), n=3))
    if near:
        return f"'{name}' given; there is no such {what}; did you mean {' or '.join(repr(n) for n in near)}?"
    more = f" and {len(known) - 20} more" if len(known) > 20 else ""
    return f"'{name}' given; there is no such {what}; there are {', '.join(known[:20]) or 'none'}{more}"


def rate_hz(tracks: Tracks, key: str) -> float:
    """Return the frame rate [Hz] from the samples' times; EditError where they do not determine it."""
    frames, first = np.unique(tracks.frame, return_index=True)
    duration_s = 1e-9 * float(tracks.time_ns[first[-1]] - tracks.time_ns[first[0]])
    if duration_s <= 0:
        raise EditError(key, "the times of the samples do not tell a frame rate; two frames or more are wanted")
    return float(frames[-1] - frames[0]) / duration_s
