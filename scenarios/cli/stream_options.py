"""Options of the verbs that stream: addresses, protocols, and the axis that points up."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from mosca import __version__
from mosca.errors import InputError
from scenarios.cli.options import FILE

if TYPE_CHECKING:
    from hardware.streams.turns import UpAxis
    from scenarios.run.stream_servers import StreamSettings

STREAMS = ("natnet", "lsl", "foxglove")
VERSIONS = ("3.0", "3.1", "4.0", "4.1")
_PORT = click.IntRange(0, 65535)
_KEYS: dict[str, dict[str, str]] = {
    "address": {"natnet": "address", "foxglove": "address"},
    "multicast": {"natnet": "group"},
    "command_port": {"natnet": "command_port"},
    "data_port": {"natnet": "data_port"},
    "protocol": {"natnet": "version"},
    "unlabelled": {"lsl": "places"},
    "port": {"foxglove": "port"},
    "app_name": {"natnet": "name", "lsl": "name", "foxglove": "name"},
}
"""Option -> protocol that has this option -> field of the protocol's settings."""


def stream_options(default: str | None, address: str = "--address") -> Callable[[Any], Any]:
    """Add --stream (``default``: its default) and related options; ``stream_settings`` takes them out again.

    ``address``: name of the option with the address to serve at.
    """
    options = (
        click.option(
            "--stream",
            type=click.Choice(STREAMS),
            multiple=True,
            default=() if default is None else (default,),
            show_default=default is not None,
            help="serve markers and bodies to clients of OptiTrack, the Lab Streaming Layer, Foxglove  [repeatable]",
        ),
        click.option(
            address, "address" if address == "--address" else "stream_address",
            help="address of this machine to serve at  [default: 127.0.0.1, this machine alone]",
        ),
        click.option(
            "--multicast", metavar="GROUP", help="natnet: multicast group, e.g. 239.255.42.99  [default: unicast]"
        ),
        click.option("--command-port", type=_PORT, help="natnet: command port; 0: a free port  [default: 1510]"),
        click.option("--data-port", type=_PORT, help="natnet: data port; 0: a free port  [default: 1511]"),
        click.option("--protocol", type=click.Choice(VERSIONS), help="natnet: version  [default: 3.1]"),
        click.option(
            "--unlabelled", type=click.IntRange(0, 1000),
            help="lsl: number of slots for markers without a label  [default: 32 in a stream without labels, else 0]",
        ),
        click.option("--port", type=_PORT, help="foxglove: port; 0: a free port  [default: 8765]"),
        click.option("--up", type=click.Choice(["z", "y"]), help="axis of the stream that points up  [default: z]"),
        click.option("--app-name", help="name under which the server announces itself  [default: mosca]"),
    )  # fmt: skip

    def add(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def fault_options(command: Any) -> Any:
    """Add --fault and --faults: faults of the streams."""
    command = click.option("--faults", type=FILE, help="TOML file of a stream's faults over time")(command)
    return click.option(
        "--fault", "fault", multiple=True, metavar="NAME[=VALUE][@AT_S[+FOR_S]]",
        help="make this fault in the stream  [repeatable]",
    )(command)  # fmt: skip


def stream_settings(given: dict[str, Any]) -> tuple[tuple["StreamSettings", ...], "UpAxis"]:
    """Take the stream's options out of ``given``; return each stream's settings, and the axis that points up.

    InputError where an option is given without a stream that has it, or has an impossible value.
    """
    kinds, up = tuple(dict.fromkeys(given.pop("stream"))), given.pop("up")
    address = "stream_address" if "stream_address" in given else "address"
    options = {key: given.pop(address if key == "address" else key) for key in _KEYS}
    fields: dict[str, dict[str, Any]] = {kind: {} for kind in kinds}
    for option, value in options.items():
        of = [kind for kind in kinds if kind in _KEYS[option]]
        for kind in of:
            fields[kind][_KEYS[option][kind]] = value
        if value is not None and not of:
            said = (address if option == "address" else option).replace("_", "-")
            raise InputError(f"--{said} {value}: is of streams; give --stream {next(iter(_KEYS[option]))}")
    if up is not None and not kinds:
        raise InputError(f"--up {up}: is of streams; give --stream {STREAMS[0]}")
    axis: UpAxis = "y" if up == "y" else "z"
    return tuple(
        _settings(kind, {k: v for k, v in fields[kind].items() if v is not None}, axis) for kind in kinds
    ), axis


def _settings(kind: str, fields: dict[str, Any], up: "UpAxis") -> "StreamSettings":
    if kind == "lsl":
        from hardware.streams.lsl.outlets import LslSettings

        return LslSettings(**fields, up=up, version=__version__)
    if kind == "foxglove":
        from hardware.streams.foxglove_server import FoxgloveSettings

        return FoxgloveSettings(**fields, up=up)
    from hardware.streams.natnet.settings import NatNetSettings

    if "version" in fields:
        major, minor = fields["version"].split(".")
        fields["version"] = int(major), int(minor)
    a, b, c = (int(part) for part in __version__.split(".")[:3])
    return NatNetSettings(**fields, server_version=(a, b, c, 0), up_axis="xyz".index(up))
