"""Interface of the messaging engines between stations, and their keys.

| key | meaning |
|---|---|
| ``mosca/STATION/CAMERA/detections`` | published: one camera, one pulse (``hardware.transport.messages``) |
| ``mosca/STATION/health`` | published, and queried: state of the station |
| ``mosca/STATION/clock`` | queried: the station's clock |
| ``mosca/STATION/rig`` | queried: its rig file, calibrated or not |
| ``mosca/STATION/start`` | query: start the session at this time of the station's clock |
| ``mosca/heard`` | query: whether a station's last message was received (``hardware.transport.messages``) |

The reconstructing station is one of the names: it answers ``rig``. A station is present as long as its messages and
answers are received: the engine's own reports of who is present are not signed.
"""

import re
from collections.abc import Callable, Sequence
from typing import Protocol

from mosca.errors import InputError, MoscaError

ROOT = "mosca"
EVERYTHING = f"{ROOT}/**"
"""All publications, by one subscription, so that a station's last message comes after its last detections."""
HEARD = f"{ROOT}/heard"
JAM_S = 0.25
"""A message that cannot be sent for this time is too old: the merger drops it (``hardware.transport.merger``)."""


class TransportError(MoscaError):
    """An engine that is not installed, or an endpoint that cannot be used; in one line."""


class Transport(Protocol):
    """Publishes, queries and subscribes. Callbacks run on the engine's threads, one at a time per subscription."""

    def publish(self, key: str, payload: bytes) -> bool:
        """Send to all subscribers; dropped where the queue stays full. False where the engine refuses it."""
        ...

    def subscribe(self, pattern: str, take: Callable[[str, bytes], None]) -> None:
        """Call ``take(key, payload)`` for publications under ``pattern``; ``*`` is one name, ``**`` any names."""
        ...

    def declare_queryable(self, key: str, reply: Callable[[bytes], bytes]) -> None:
        """Answer queries for ``key``."""
        ...

    def query(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """Return the answer to ``payload``, None without one within ``timeout_s``."""
        ...

    def close(self) -> None:
        """Leave; may be called twice."""
        ...


def check_endpoint(text: str) -> str:
    """Return ``text`` where it can be an endpoint; TransportError shows the form.

    Engines accept invalid endpoints, and then wait for ever.
    """
    found = re.fullmatch(r"(?:tcp|udp|tls|quic|ws)/[^/?#]+:(\d{1,5})(?:[?#].*)?", text)
    if found is None or not 0 < int(found[1]) < 65536:
        raise TransportError(f"endpoint '{text}': endpoints look like tcp/192.168.7.1:7447, the port at its end")
    return text


def host_of(endpoint: str) -> str:
    """Return the host of an endpoint that ``check_endpoint`` has passed."""
    return re.sub(r":\d+(?:[?#].*)?$", "", endpoint.partition("/")[2]).strip("[]")


def check_station(name: str) -> str:
    """Return ``name`` where it can be a station's; InputError lists what is allowed."""
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,60}", name):
        raise InputError(f"station name '{name}' given; 1 to 60 letters, digits, _ and - are allowed")
    return name


def check_stations(names: Sequence[str]) -> None:
    """Raise InputError where ``names`` are empty, two are the same, or one cannot be a station's."""
    if not names or len(set(names)) < len(names):
        raise InputError(f"stations {', '.join(names) or 'none'} given; one or more different names are wanted")
    for name in names:
        check_station(name)


def key_of(station: str, *parts: str) -> str:
    """Return the key of a station's ``parts``, e.g. ``key_of("A", "left", "detections")``."""
    return "/".join((ROOT, station, *parts))


def station_of(key: str) -> str:
    """Return the station that a key names, "" where it names none."""
    parts = key.split("/")
    return parts[1] if len(parts) > 1 else ""


def word_of(key: str) -> str:
    """Return the last part of a key: the kind of its content."""
    return key.rpartition("/")[2]
