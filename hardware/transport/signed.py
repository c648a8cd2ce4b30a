"""Messages between stations that are signed with a key that all of them share (HMAC-SHA256, RFC 2104).

A publication is a tag of 32 bytes, session (8 random bytes of this start of its sender), sequence (uint64, counts up
per key) and the payload. The tag covers all of these, the kind of message and its key. A query is built alike. An
answer is its tag and the payload; its tag also covers the query's session and sequence, which ties it to this query.
A message that is not signed, was changed, or was received before is refused, counted and logged, and has no other
effect. Contents are not encrypted.
"""

import hashlib
import hmac
import logging
import os
import secrets
import struct
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from hardware.transport.transport import Transport, station_of
from mosca.data.files.bounded import read_bytes
from mosca.errors import InputError

log = logging.getLogger("mosca.hardware.stations")
TAG_BYTES, KEY_BYTES = 32, 32
_HEAD = struct.Struct("<8sQ")
MOST_NAMED = 100
"""Most keys whose refused messages are logged by name, since a stranger may invent any number of them."""
FORGED = "is not signed with this station's key: forged or changed on the way, or the key files differ"
REPLAYED = "was received before: somebody sends it again"


def read_key(path: Path) -> bytes:
    """Return the key in the file at ``path``: 64 hexadecimal digits; InputError states how to make one."""
    try:
        text = read_bytes(path).decode("ascii").strip()
        key = bytes.fromhex(text)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; make a key with: mosca station key {path}") from None
    except ValueError:  # not ascii, or not hexadecimal
        key = b""
    if len(key) != KEY_BYTES:
        raise InputError(
            f"{path}: is no key; one line of {2 * KEY_BYTES} hexadecimal digits is wanted; make one with: "
            "mosca station key FILE"
        )
    return key


def write_key(path: Path) -> None:
    """Write a new random key that only its owner can read; InputError where ``path`` exists or cannot be written."""
    try:
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            file.write(secrets.token_hex(KEY_BYTES) + "\n")
    except FileExistsError:
        raise InputError(
            f"{path}: exists; a new key would lock out the stations that have it: delete it first"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


class SignedTransport:
    """A ``Transport`` over another: signs sent messages with ``key``, and passes on those signed with it.

    ``refused``: messages that were not passed on, by station. ``on_refused(station, why)`` is called at the first of
    a kind, from the engine's threads.
    """

    def __init__(self, inner: Transport, key: bytes) -> None:
        self.refused: Counter[str] = Counter()
        self.on_refused: Callable[[str, str], None] = lambda station, why: None
        self._inner, self._key = inner, key
        self._session = secrets.token_bytes(8)
        self._sent: Counter[str] = Counter()
        self._sending: dict[str, threading.Lock] = {}
        self._seen: dict[tuple[str, str, bytes], int] = {}
        self._told: set[tuple[str, str]] = set()
        self._guard = threading.Lock()

    def publish(self, key: str, payload: bytes) -> bool:
        """Sign and send; see ``Transport``."""
        with self._guard:
            sending = self._sending.setdefault(key, threading.Lock())
        with sending:  # so that a later message has the greater number
            return self._inner.publish(key, self._signed("publication", key, payload)[1])

    def subscribe(self, pattern: str, take: Callable[[str, bytes], None]) -> None:
        """Pass on signed publications; see ``Transport``."""

        def checked(key: str, data: bytes) -> None:
            if (opened := self._opened("publication", key, data)) is not None:
                take(key, opened[1])

        self._inner.subscribe(pattern, checked)

    def declare_queryable(self, key: str, reply: Callable[[bytes], bytes]) -> None:
        """Answer signed queries; others get an empty answer, which nobody accepts."""

        def answered(data: bytes) -> bytes:
            opened = self._opened("query", key, data)
            if opened is None:
                return b""
            head, payload = opened
            answer = reply(payload)
            return self._tag("answer", key, head, answer) + answer

        self._inner.declare_queryable(key, answered)

    def query(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """Return the signed answer to this query, None without one."""
        head, data = self._signed("query", key, payload)
        answer = self._inner.query(key, data, timeout_s)
        if answer is None:
            return None
        tag, said = answer[:TAG_BYTES], answer[TAG_BYTES:]
        if not hmac.compare_digest(tag, self._tag("answer", key, head, said)):
            self._refuse(key, FORGED)
            return None
        return said

    def close(self) -> None:
        """Leave; may be called twice."""
        self._inner.close()

    def _tag(self, what: str, key: str, head: bytes, payload: bytes) -> bytes:
        # the names contain no zeros, and the head has one length: no two messages give the same bytes
        text = b"\0".join((what.encode(), key.encode(), head)) + payload
        return hmac.digest(self._key, text, hashlib.sha256)

    def _signed(self, what: str, key: str, payload: bytes) -> tuple[bytes, bytes]:
        """Return session and sequence, and the message with them."""
        with self._guard:
            self._sent[key] += 1
            head = _HEAD.pack(self._session, self._sent[key])
        return head, self._tag(what, key, head, payload) + head + payload

    def _opened(self, what: str, key: str, data: bytes) -> tuple[bytes, bytes] | None:
        """Return session and sequence, and the payload, of a message that is new and signed; else None."""
        tag, rest = data[:TAG_BYTES], data[TAG_BYTES:]
        head, payload = rest[: _HEAD.size], rest[_HEAD.size :]
        if len(head) < _HEAD.size or not hmac.compare_digest(tag, self._tag(what, key, head, payload)):
            self._refuse(key, FORGED)
            return None
        session, sequence = _HEAD.unpack(head)
        with self._guard:
            new = sequence > self._seen.get((what, key, session), 0)
            if new:
                self._seen[what, key, session] = sequence
        if not new:
            self._refuse(key, REPLAYED)
            return None
        return head, payload

    def _refuse(self, key: str, why: str) -> None:
        station = station_of(key)
        with self._guard:
            if station not in self.refused and len(self.refused) >= MOST_NAMED:
                station = "others"
            self.refused[station] += 1
            first = (station, why) not in self._told
            self._told.add((station, why))
        if first:
            log.warning("station %s: a message under '%s' %s; it is refused", station, key, why)
            self.on_refused(station, f"a message in its name {why}; refused")
