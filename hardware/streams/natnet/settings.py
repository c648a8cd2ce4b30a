"""Settings of a NatNet server, the account of a client, and the server's sockets."""

import socket
from dataclasses import dataclass
from ipaddress import IPv4Address

from hardware.streams.natnet.messages import VERSIONS, Version
from mosca.errors import InputError

Address = tuple[str, int]


@dataclass(frozen=True)
class NatNetSettings:
    """Where and how a server answers; ports 0: free ones."""

    address: str = "127.0.0.1"
    command_port: int = 1510
    data_port: int = 1511
    group: str | None = None
    """Multicast group that frames go to; None: unicast to each client."""
    version: Version = (3, 1)
    name: str = "mosca"
    """Name of the application, as sent to clients."""
    server_version: tuple[int, int, int, int] = (0, 0, 0, 0)
    rate_hz: float = 100.0
    """Answer to a client that asks for the frame rate."""
    up_axis: int = 2
    """Index of the axis x, y or z that points up; answer to a client that asks for it."""
    forget_s: float = 10.0
    """A unicast client that sends nothing for so long is dropped, unless frames go to the data port."""
    settle_s: float = 0.25
    """Time from CONNECT to the first frame, unless the client's next command comes earlier: some clients take the
    first message after their request for the model as its answer."""
    most_clients: int = 64

    def __post_init__(self) -> None:
        if self.version not in VERSIONS:
            allowed = ", ".join(f"{a}.{b}" for a, b in VERSIONS)
            raise InputError(f"NatNet version {self.version[0]}.{self.version[1]} given; {allowed} are spoken")
        if self.group is not None and not _is_multicast(self.group):
            raise InputError(f"multicast group '{self.group}' given; 224.0.0.0 to 239.255.255.255 are such groups")


@dataclass
class ClientAccount:
    """What became of the frames of one client, or of the group."""

    address: Address
    """Where its commands come from, or the group."""
    to: Address
    """Where frames go."""
    version: Version
    sent: int = 0
    dropped: int = 0
    """Frames that its send buffer did not take."""
    commands: int = 0
    heard_s: float = 0.0
    left: str = ""
    """Why it is no longer a client: "disconnected", "gone" (its port is closed), "silent", "server restarted"."""

    def count(self, outcome: bool | None) -> None:
        """Count what became of a frame, as ``sent_whole`` returned it."""
        if outcome:
            self.sent += 1
        else:
            self.dropped += 1


def sent_whole(sock: socket.socket, data: bytes, to: Address | None = None) -> bool | None:
    """Send without waiting; return whether the message was taken, None where nobody is there any more.

    With a full buffer or a pulled cable this message is lost, but the next may not be.
    """
    try:
        return (sock.send(data) if to is None else sock.sendto(data, to)) == len(data)
    except ConnectionRefusedError:
        return None
    except OSError:
        return False


def bound(address: str, port: int, exclusive: bool) -> socket.socket:
    """Return a bound non-blocking socket; others of this server may share its port, another server may not."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.setblocking(False)
        if not exclusive:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((address, port))
        # only now: a second server, which binds without it, is refused
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    except (OSError, OverflowError) as error:
        made.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{address}:{port}: {reason}; give an address of this machine and ports that no other server has"
        ) from None
    return made


def _is_multicast(text: str) -> bool:
    try:
        return IPv4Address(text).is_multicast
    except ValueError:
        return False


def free_port(address: str) -> int:
    """Return a port of ``address`` that is free now."""
    with bound(address, 0, exclusive=True) as one:
        return int(one.getsockname()[1])
