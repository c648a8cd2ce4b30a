"""Transport of detections, health and clock between the PCs of a rig; one engine a file, imported when opened."""

import ipaddress
from collections.abc import Sequence
from typing import NamedTuple

from hardware.transport.signed import SignedTransport
from hardware.transport.transport import JAM_S, Transport, TransportError, check_endpoint, host_of


class Trust(NamedTuple):
    """Whose messages are taken: those signed with ``key`` (32 bytes), all with ``insecure``, else this PC's."""

    key: bytes | None = None
    insecure: bool = False


def open_transport(
    connect: Sequence[str] = (), listen: Sequence[str] = (), jam_s: float = JAM_S, trust: Trust | None = None
) -> Transport:
    """Open the engine; TransportError where it is not installed or an endpoint cannot be used.

    ``connect``, ``listen``: endpoints such as ``tcp/192.168.7.1:7447``. The listening end may start later.
    ``jam_s``: how long a message may wait for the network before it is dropped. ``trust``: without a key, only
    endpoints of this PC (loopback) can be used, unless it is ``insecure``.
    """
    trust = trust or Trust()
    for endpoint in (*connect, *listen):
        if trust == Trust() and not _is_loopback(host_of(check_endpoint(endpoint))):
            raise TransportError(
                f"endpoint '{endpoint}': is open to the network, and no key is given; give all stations the same key "
                "(--key FILE; 'mosca station key FILE' makes one), or take every program's messages (--insecure)"
            )
    try:
        from hardware.transport.zenoh_engine import ZenohTransport
    except ImportError as error:
        raise TransportError(
            f"stations cannot talk to each other ({error}); pip install 'mosca-testbench[stations]'"
        ) from None
    engine = ZenohTransport(connect, listen, jam_s)
    return engine if trust.key is None else SignedTransport(engine, trust.key)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name: it may stand for another PC tomorrow
        return host == "localhost"
