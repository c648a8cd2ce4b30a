"""The register file: addresses, access and encoding of values; and the control privilege, which permits writing."""

import struct
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from hardware.emulate.gige_vision import Refused, Status
from hardware.gvcp import CONTROL_ACCESS, EXCLUSIVE_ACCESS, KEY_BITS, SWITCHOVER_ENABLE

Kind = Literal["unsigned", "signed", "double", "text"]
Access = Literal["RO", "RW", "WO"]
Value = int | float | str
WORD = 4


@dataclass(frozen=True)
class Register:
    """``length`` bytes at ``address`` that hold one value, big-endian."""

    name: str
    address: int
    length: int = WORD
    access: Access = "RO"
    kind: Kind = "unsigned"

    def encode(self, value: Value) -> bytes:
        """Return the bytes of ``value``; what does not fit is cut to the register's length."""
        if self.kind == "text":
            return str(value).encode("utf-8", "replace")[: self.length].ljust(self.length, b"\0")
        if self.kind == "double":
            return struct.pack(">d", value)
        bits = 8 * self.length
        return (int(value) & ((1 << bits) - 1)).to_bytes(self.length, "big")

    def decode(self, data: bytes) -> Value:
        """Return the value of ``data``, which is as long as the register."""
        if self.kind == "text":
            return data.split(b"\0")[0].decode("utf-8", "replace")
        if self.kind == "double":
            return float(struct.unpack(">d", data)[0])
        return int.from_bytes(data, "big", signed=self.kind == "signed")


class RegisterFile:
    """Registers and one read-only file (the GenICam XML) in one address space.

    ``values``: contents of the registers, by name. ``live``: registers whose value is computed at each read.
    ``write`` is called with a register and the value that a client writes; it may raise Refused. Every
    refusal carries the status code of the standard.
    """

    def __init__(
        self,
        registers: Iterable[Register],
        live: Mapping[str, Callable[[], Value]],
        write: Callable[[Register, Value], None],
        file: tuple[int, bytes],
    ) -> None:
        self._registers = sorted(registers, key=lambda register: register.address)
        self._starts = [register.address for register in self._registers]
        self._live, self._write = live, write
        self._file_start, content = file
        self._file = content.ljust(-(-len(content) // WORD) * WORD, b"\0")
        self.values: dict[str, Value] = {}
        self.clear()
        for one, after in zip(self._registers, self._registers[1:], strict=False):
            if one.address + one.length > after.address:
                raise ValueError(f"registers {one.name} and {after.name} overlap at 0x{after.address:x}")

    def clear(self) -> None:
        """Set all values to 0 or empty."""
        self.values.update({r.name: "" if r.kind == "text" else 0 for r in self._registers})

    def named(self, name: str) -> Register:
        """Return register ``name``."""
        return next(register for register in self._registers if register.name == name)

    def value(self, name: str) -> Value:
        """Return what register ``name`` shows now."""
        ask = self._live.get(name)
        return self.values[name] if ask is None else ask()

    def read(self, address: int, length: int) -> bytes:
        """Return ``length`` bytes from ``address``; each must belong to something that may be read."""
        if address % WORD or length % WORD or length == 0:
            raise Refused(Status.BAD_ALIGNMENT)
        into = address - self._file_start
        if into >= 0 and into + length <= len(self._file):
            return self._file[into : into + length]
        found = b""
        while len(found) < length:
            register = self._at(address + len(found))
            if register.access == "WO":
                raise Refused(Status.ACCESS_DENIED)
            skipped = address + len(found) - register.address
            found += register.encode(self.value(register.name))[skipped:]
        return found[:length]

    def write(self, address: int, data: bytes) -> None:
        """Write ``data`` to ``address``; numbers must be complete, strings may be shorter than their register."""
        if address % WORD or len(data) % WORD or not data:
            raise Refused(Status.BAD_ALIGNMENT)
        if 0 <= address - self._file_start < len(self._file):
            raise Refused(Status.WRITE_PROTECT)
        at = 0
        while at < len(data):
            register = self._at(address + at)
            if register.access == "RO":
                raise Refused(Status.WRITE_PROTECT)
            given = data[at : at + register.length]
            whole = register.address == address + at and len(given) == register.length
            if register.kind == "text" and register.address == address + at:
                given = given.ljust(register.length, b"\0")
            elif not whole:
                raise Refused(Status.INVALID_ADDRESS)
            self._write(register, register.decode(given))
            at += register.length

    def _at(self, address: int) -> Register:
        found = bisect_right(self._starts, address) - 1
        if found >= 0:
            register = self._registers[found]
            if address < register.address + register.length:
                return register
        raise Refused(Status.INVALID_ADDRESS)


Client = tuple[str, int]
MILLION = 1_000_000


class Privilege:
    """Control privilege of at most one client (address and port); anyone may read unless access is exclusive."""

    def __init__(self) -> None:
        self.holder: Client | None = None
        self.level = 0
        self._heard_ns = 0

    def ask(self, client: Client, value: int, now_ns: int, key: int | None = None) -> bool:
        """Give ``client`` the access that it writes as ``value`` (0: give it back); Refused where another holds it.

        Parameters
        ----------
        client
            Who asks.
        value
            Access in the lower bits; in the upper 16 bits the key with which the control is taken over.
        now_ns
            Time of this machine's monotonic clock [ns].
        key
            The camera's own key; None where no client can take the control over.

        Returns
        -------
        bool
            Whether it was given back.
        """
        access = value & (EXCLUSIVE_ACCESS | CONTROL_ACCESS)
        if self.holder not in (None, client):
            allowed = key is not None and self.level == CONTROL_ACCESS | SWITCHOVER_ENABLE
            if not (allowed and access and value >> KEY_BITS == key):
                raise Refused(Status.ACCESS_DENIED)
        had = self.holder is not None
        shared = key is not None and access == CONTROL_ACCESS
        self.level = access | (value & SWITCHOVER_ENABLE if shared else 0)
        self.holder = client if self.level else None
        self._heard_ns = now_ns
        return had and not self.level

    def check_write(self, client: Client) -> None:
        """Refuse a write by a client that does not hold control."""
        if self.holder != client:
            raise Refused(Status.ACCESS_DENIED)

    def check_read(self, client: Client) -> None:
        """Refuse a reading where another client has exclusive access."""
        if self.level & EXCLUSIVE_ACCESS and self.holder != client:
            raise Refused(Status.ACCESS_DENIED)

    def heartbeat(self, client: Client, now_ns: int) -> None:
        """Register that ``client`` is alive: each command of the holder counts as a heartbeat."""
        if client == self.holder:
            self._heard_ns = now_ns

    def expired(self, now_ns: int, timeout_ms: int) -> bool:
        """Return whether the holder has been silent for longer than ``timeout_ms``."""
        return self.holder is not None and now_ns - self._heard_ns > timeout_ms * MILLION

    def drop(self) -> None:
        """Take the control away."""
        self.holder, self.level = None, 0
