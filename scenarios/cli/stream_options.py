"""Options of the verbs that stream: where to, in which protocol, and which way is up."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from mosca import __version__
from mosca.errors import InputError

if TYPE_CHECKING:
    from hardware.streams.content import UpAxis
    from hardware.streams.natnet.settings import NatNetSettings

STREAMS = ("natnet",)
VERSIONS = ("3.0", "3.1", "4.0", "4.1")
_PORT = click.IntRange(0, 65535)
_KEYS = {
    "address": "address",
    "multicast": "group",
    "command_port": "command_port",
    "data_port": "data_port",
    "app_name": "name",
    "protocol": "version",
}
"""Option -> field of the settings."""


def stream_options(default: str | None) -> Callable[[Any], Any]:
    """Add --stream (``default``: without it) and what goes with it; ``stream_settings`` takes them out again."""
    options = (
        click.option(
            "--stream",
            type=click.Choice(STREAMS),
            default=default,
            show_default=default is not None,
            help="serve markers and bodies to clients of this protocol (OptiTrack's)",
        ),
        click.option("--address", help="of this machine, to serve at  [default: 127.0.0.1, this machine alone]"),
        click.option("--multicast", metavar="GROUP", help="send to this group, as 239.255.42.99  [default: unicast]"),
        click.option("--command-port", type=_PORT, help="0: a free one  [default: 1510]"),
        click.option("--data-port", type=_PORT, help="0: a free one  [default: 1511]"),
        click.option("--protocol", type=click.Choice(VERSIONS), help="version of the protocol  [default: 3.1]"),
        click.option("--up", type=click.Choice(["z", "y"]), help="axis of the stream that points up  [default: z]"),
        click.option("--app-name", help="name that the server gives itself  [default: mosca]"),
    )

    def add(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def stream_settings(given: dict[str, Any]) -> tuple["NatNetSettings | None", "UpAxis"]:
    """Take the stream's options out of ``given``; return its settings, None without a stream, and the axis up.

    InputError where an option is given without --stream, or cannot be.
    """
    kind, up = given.pop("stream"), given.pop("up")
    options = {option: given.pop(option) for option in _KEYS}
    used = {option: value for option, value in {**options, "up": up}.items() if value is not None}
    if kind is None:
        for option, value in used.items():
            raise InputError(f"--{option.replace('_', '-')} {value}: is of streams; give --stream {STREAMS[0]}")
        return None, "z"
    from hardware.streams.natnet.settings import NatNetSettings

    keys: dict[str, Any] = {_KEYS[option]: value for option, value in options.items() if value is not None}
    if "version" in keys:
        major, minor = keys["version"].split(".")
        keys["version"] = int(major), int(minor)
    numbers = [int(part) for part in __version__.split(".")[:3]]
    axis: UpAxis = "y" if up == "y" else "z"
    return NatNetSettings(**keys, server_version=(*numbers, 0), up_axis="xyz".index(axis)), axis  # type: ignore[arg-type]
