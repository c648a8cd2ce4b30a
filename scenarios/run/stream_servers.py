"""The servers of a stream, one for each requested protocol."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace

from hardware.streams.foxglove_server import FoxgloveServer, FoxgloveSettings
from hardware.streams.lsl.outlets import LslServer, LslSettings
from hardware.streams.natnet.server import NatNetServer
from hardware.streams.natnet.settings import NatNetSettings
from hardware.streams.stream_server import JoinedServers, StreamServer
from hardware.streams.values import StreamModel, StreamNames
from mosca.errors import InputError

StreamSettings = NatNetSettings | LslSettings | FoxgloveSettings


def opened_streams(
    settings: Sequence[StreamSettings], model: StreamModel, names: StreamNames, rate_hz: float
) -> StreamServer:
    """Return a server of all protocols in ``settings`` (at least one).

    Raises InputError where one of them cannot be opened; then none stays open.
    """
    made: list[StreamServer] = []
    with ExitStack() as stack:
        for one in settings:
            server: StreamServer
            match one:
                case NatNetSettings():
                    server = NatNetServer(model, replace(one, rate_hz=rate_hz))
                case LslSettings():
                    server = LslServer(model, names, replace(one, rate_hz=rate_hz))
                case FoxgloveSettings():
                    server = FoxgloveServer(model, names, one)
            made.append(stack.enter_context(server))
        stack.pop_all()
    return made[0] if len(made) == 1 else JoinedServers(made)


def check_wait(settings: Sequence[StreamSettings], wait: int) -> None:
    """Raise InputError where the number of clients to wait for is larger than the protocols can count."""
    if wait > 1 and all(isinstance(one, LslSettings) for one in settings):
        raise InputError(f"--wait {wait}: LSL shows whether somebody listens, not how many; 0 or 1 is wanted")
