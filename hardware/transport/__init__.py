"""Carries detections, health and clock between the PCs of a rig; one engine a file, imported when opened."""

from collections.abc import Sequence

from hardware.transport.transport import JAM_S, Transport, TransportError


def open_transport(connect: Sequence[str] = (), listen: Sequence[str] = (), jam_s: float = JAM_S) -> Transport:
    """Open the engine; TransportError where it is not installed or an endpoint cannot be used.

    ``connect``, ``listen``: endpoints such as ``tcp/192.168.7.1:7447``. The one that listens may come later.
    ``jam_s``: how long a message may wait for the network before it is dropped.
    """
    try:
        from hardware.transport.zenoh_engine import ZenohTransport
    except ImportError as error:
        raise TransportError(
            f"stations cannot talk to each other ({error}); pip install 'mosca-testbench[stations]'"
        ) from None
    return ZenohTransport(connect, listen, jam_s)
