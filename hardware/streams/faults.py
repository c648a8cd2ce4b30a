"""Faults on demand in a stream: their names, the times at which they act, and records of their action.

A file of faults lists them over time, as a program file lists commands::

    seed = 1                    # of the random draws

    [[program]]
    at_s = 5.0                  # from the first frame on, on the take's clock
    for_s = 2.0                 # default: to the end; connection-lost 2 s, restart 1 s
    fault = "latency"
    value = 0.03

Faults of the messages act on the way: their stamps stay those of an undisturbed transmission.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from pydantic import Field, field_validator, model_validator

from mosca.data.files.toml import NotNegative, Positive, Table, check, read_toml
from mosca.errors import InputError

FaultName = Literal[
    "latency", "jitter", "burst-loss", "half-rate", "duplicate", "reorder", "clock-offset", "clock-drift",
    "label-swap", "ghosts", "body-lost", "body-swap", "camera-moved", "connection-lost", "restart",
]  # fmt: skip


class FaultKind(NamedTuple):
    """What a fault does, its default value, and how many names of markers or bodies it may take."""

    what: str
    value: float
    names: int = 0
    for_s: float | None = None
    """Default; None: to the end."""
    most: float = float("inf")


KINDS: Mapping[FaultName, FaultKind] = {
    "latency": FaultKind("messages come so much later [s]", 0.05, most=10.0),
    "jitter": FaultKind("messages come later by up to so much [s], drawn evenly; their order stays", 0.02, most=10.0),
    "burst-loss": FaultKind("so many messages in a row are lost, at the start and each second after it", 10),
    "half-rate": FaultKind("every second frame is left out", 0),
    "duplicate": FaultKind("each so-many-th message comes twice", 10),
    "reorder": FaultKind("each so-many-th message comes after its successor", 10),
    "clock-offset": FaultKind("the server's clock is ahead by so much [s]", 0.01),
    "clock-drift": FaultKind("the server's clock gains so much [ppm]; at the end it keeps what it gained", 100),
    "label-swap": FaultKind("two markers (names, default the first two) have each other's label", 0, 2),
    "ghosts": FaultKind("so many markers that stand still among the others and have no label", 1, most=1000),
    "body-lost": FaultKind("a body (name, default the first) is not tracked and keeps its last pose", 0, 1),
    "body-swap": FaultKind("two bodies (names, default the first two) have each other's pose", 0, 2),
    "camera-moved": FaultKind(
        "one of four cameras has turned by so much [rad]: what it sees is displaced by its share in it",
        0.005,
        most=1.0,
    ),
    "connection-lost": FaultKind("nothing arrives at the server or leaves it", 0, for_s=2.0),
    "restart": FaultKind(
        "the server ends and starts again after for_s, without clients, frames from 0 on", 0, for_s=1.0
    ),
}
_COUNTS = ("burst-loss", "duplicate", "reorder", "ghosts")
_SIGNED = ("clock-offset", "clock-drift")
_WORD = re.compile(r"([a-z-]+)(?:=([-+.\dEe]+))?(?:@([.\de]+)(?:\+([.\de]+))?)?")


class StreamFault(Table):
    """``[[program]]``: one fault and when it acts."""

    fault: FaultName = Field(description="its name")
    at_s: NotNegative = Field(0.0, description="when it begins, from the first frame on [s]")
    for_s: Positive | None = Field(
        None, description="how long it lasts [s]; default: to the end, or as its kind has it"
    )
    value: float | None = Field(None, description="how much, in the unit of its kind; default: its kind's")
    names: tuple[str, ...] = Field((), description="labels or bodies that it acts on")

    @model_validator(mode="after")
    def _fits(self) -> "StreamFault":
        kind, value = KINDS[self.fault], self.amount
        if len(self.names) not in (0, kind.names):
            raise ValueError(f"fault '{self.fault}': {len(self.names)} names given; {kind.names} or none are wanted")
        if self.fault in _COUNTS and not (value >= 1 and value == int(value)):
            raise ValueError(f"fault '{self.fault}': value = {value:g} given; a whole number from 1 on is wanted")
        if self.fault not in _SIGNED and not 0 <= value <= kind.most:
            raise ValueError(f"fault '{self.fault}': value = {value:g} given; 0 to {kind.most:g} is wanted")
        if self.fault in _SIGNED and not abs(value) <= 1e6:
            raise ValueError(f"fault '{self.fault}': value = {value:g} given; -1000000 to 1000000 is wanted")
        return self

    @property
    def amount(self) -> float:
        """Amount of the fault: ``value``, or the default of its kind."""
        return KINDS[self.fault].value if self.value is None else self.value

    @property
    def until_s(self) -> float:
        """Time at which it ends [s]; infinity: with the stream."""
        lasts = self.for_s or KINDS[self.fault].for_s
        return float("inf") if lasts is None else self.at_s + lasts

    def active(self, at_s: float) -> bool:
        """Return whether it acts at a time from the first frame on [s]."""
        return self.at_s <= at_s < self.until_s


class StreamFaults(Table):
    """A file of faults."""

    seed: int = Field(0, ge=0, description="of what is drawn")
    program: tuple[StreamFault, ...] = Field((), description="[[program]] tables")

    @field_validator("program")
    @classmethod
    def _not_too_many(cls, value: tuple[StreamFault, ...]) -> tuple[StreamFault, ...]:
        if len(value) > 1000:
            raise ValueError(f"{len(value)} faults given; 1000 are allowed")
        return value


def read_faults(path: Path) -> StreamFaults:
    """Return the faults in the file at ``path``; InputError names what is wrong."""
    return check(StreamFaults, read_toml(path), path)


def fault_of(text: str) -> StreamFault:
    """Return the fault that a command line gives: NAME[=VALUE][@AT_S[+FOR_S]]; InputError for another text."""
    found = _WORD.fullmatch(text)
    if found is None or found[1] not in KINDS:
        known = ", ".join(KINDS)
        raise InputError(
            f"--fault {text}: NAME[=VALUE][@AT_S[+FOR_S]] is wanted, as latency=0.03@5+2; names: {known}"
        )
    keys = {"value": found[2], "at_s": found[3], "for_s": found[4]}
    try:
        given = {key: float(number) for key, number in keys.items() if number is not None}
    except ValueError:
        raise InputError(f"--fault {text}: a number is wanted after =, @ and +, as latency=0.03@5+2") from None
    return check(StreamFault, {"fault": found[1], **given}, f"--fault {text}")


def ordered_faults(named: Sequence[str], file: Path | None, seed: int | None) -> StreamFaults:
    """Return the faults of a file and those that a command line names; ``seed`` None: the file's, or 0."""
    given = StreamFaults() if file is None else read_faults(file)
    program = (*given.program, *(fault_of(text) for text in named))
    return StreamFaults(seed=given.seed if seed is None else seed, program=program)


@dataclass
class FaultAccount:
    """Record of a fault: how many frames it acted on, and the stream's times of the first and the last."""

    fault: StreamFault
    count: int = 0
    first_s: float | None = None
    last_s: float | None = None

    def add(self, at_s: float) -> None:
        """Count one more."""
        self.count += 1
        self.first_s = at_s if self.first_s is None else self.first_s
        self.last_s = at_s

    def line(self) -> str:
        """Return it as a line."""
        fault = self.fault
        told = f"fault {fault.fault}" + (f" {fault.amount:g}" if fault.amount else "")
        told += f" ({', '.join(fault.names)})" if fault.names else ""
        if self.first_s is None:
            return f"{told}: not made, it was ordered from {fault.at_s:g} s on"
        return f"{told}: {self.count} frames from {self.first_s:.3f} s to {self.last_s:.3f} s"


def check_names(faults: Sequence[StreamFault], labels: Sequence[str], bodies: Sequence[str]) -> None:
    """Raise InputError where a fault acts on markers or bodies that the stream does not have."""
    for fault in faults:
        wanted = KINDS[fault.fault].names
        there, what = (labels, "labels") if fault.fault == "label-swap" else (bodies, "bodies")
        missing = next((name for name in fault.names if name not in there), None)
        known = ", ".join(there[:12]) or "none"
        if missing is not None:
            raise InputError(f"fault '{fault.fault}': no '{missing}' in the stream; its {what}: {known}")
        if len(there) < wanted:
            raise InputError(f"fault '{fault.fault}': {wanted} {what} are wanted; the stream's: {known}")
