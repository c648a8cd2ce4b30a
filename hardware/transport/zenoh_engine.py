"""Zenoh between stations: TCP peers with explicit endpoints, no multicast scouting."""

import json
import re
import threading
from collections.abc import Callable, Sequence
from typing import Any

import zenoh

from hardware.transport.transport import JAM_S, TransportError, check_endpoint

LEASE_MS = 4000
"""Silence after which a peer counts as lost and is connected again."""


QUEUED_BATCHES = 16
"""Most messages (of 64 kB at most) that wait for the network; further ones are dropped, and missing in the count."""


class ZenohTransport:
    """A ``Transport``.

    ``connect``, ``listen``: endpoints like ``tcp/10.0.0.1:7447``; the listening peer may start later. ``jam_s``: how
    long a message waits at a full queue; after that the next ones are dropped at once until it has space.
    """

    def __init__(self, connect: Sequence[str] = (), listen: Sequence[str] = (), jam_s: float = JAM_S) -> None:
        config = zenoh.Config()
        settings: dict[str, Any] = {
            "mode": "peer",
            "connect/endpoints": list(connect),
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "connect/retry": {
                "period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5,
            },
            "listen/endpoints": list(listen),
            "listen/timeout_ms": 0,
            "listen/exit_on_failure": True,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/link/tx/lease": LEASE_MS,
            # one batch, the default of this priority, is dropped when all cameras of a pulse are sent at once
            "transport/link/tx/queue/size/real_time": QUEUED_BATCHES,
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": round(jam_s * 1e6),
        }  # fmt: skip
        where = ", ".join([*connect, *listen]) or "no endpoint"
        for endpoint in (*connect, *listen):
            check_endpoint(endpoint)
        try:
            for key, value in settings.items():
                config.insert_json5(key, json.dumps(value))
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise TransportError(f"{where}: cannot be used ({_reason(error)})") from None
        self._guard = threading.Lock()
        self._publishers: dict[str, Any] = {}
        self._kept: list[Any] = []

    def publish(self, key: str, payload: bytes) -> bool:
        """Send, or drop where the queue stays full; False where the engine refuses."""
        try:
            with self._guard:
                publisher = self._publishers.get(key)
                if publisher is None:
                    publisher = self._session.declare_publisher(
                        key,
                        congestion_control=zenoh.CongestionControl.DROP,
                        priority=zenoh.Priority.REAL_TIME,
                        express=True,
                    )
                    self._publishers[key] = publisher
            publisher.put(payload)
        except zenoh.ZError:
            return False
        return True

    def subscribe(self, pattern: str, take: Callable[[str, bytes], None]) -> None:
        """Pass publications to ``take``."""
        self._keep(
            self._session.declare_subscriber(
                pattern, lambda sample: take(str(sample.key_expr), sample.payload.to_bytes())
            )
        )

    def declare_queryable(self, key: str, reply: Callable[[bytes], bytes]) -> None:
        """Answer queries for ``key``."""

        def answered(query: zenoh.Query) -> None:
            asked = b"" if query.payload is None else query.payload.to_bytes()
            query.reply(key, reply(asked))

        self._keep(self._session.declare_queryable(key, answered, complete=True))

    def query(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """Return the first good answer; None where there is none in time."""
        try:
            replies = self._session.get(
                key,
                payload=payload,
                timeout=timeout_s,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
            for reply in replies:
                if reply.ok is not None:
                    return bytes(reply.ok.payload.to_bytes())
        except zenoh.ZError:
            return None
        return None

    def close(self) -> None:
        """Leave the session; may be called twice."""
        if not self._session.is_closed():
            self._session.close()

    def _keep(self, declared: object) -> None:
        # a declaration is withdrawn when its object is deleted
        with self._guard:
            self._kept.append(declared)


def _reason(error: Exception) -> str:
    """Return what is wrong in a few words, else the engine's message without its source locations."""
    for message, reason in (
        ("Address already in use", "another program listens there; choose another port, or end that program"),
        ("Cannot assign requested address", "this machine has no such address; name that of its interface"),
    ):
        if message in str(error):
            return reason
    text = re.sub(r" at /\S+?:\d+\.?", "", str(error))
    return text.splitlines()[0].strip() if text else type(error).__name__
