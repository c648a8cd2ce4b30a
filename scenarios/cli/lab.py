"""The verbs of the laboratory: twin serve."""

import os
import re
import sys
from typing import TYPE_CHECKING, Any

import click

from mosca.errors import InputError
from scenarios.cli.options import FILE, OUT_FILE, POSITIVE, Number, print_table, table
from scenarios.cli.progress import Progress
from scenarios.cli.stream_options import fault_options, stream_options, stream_settings

if TYPE_CHECKING:
    from hardware.emulate.serve import Served
    from scenarios.lab.serve import ServeRequest

SHARE = Number(0.0, 1.0)


@click.command("serve")
@click.argument("what")
@click.option(
    "--address",
    default="127.0.0.2",
    show_default=True,
    help="address of the first camera; the others follow. On an interface: one of its own, e.g. 192.168.7.10/24",
)
@click.option("--rate", type=Number(0, 10_000, min_open=True), help="pulse rate [Hz]  [default: the source's]")
@click.option("--seconds", type=POSITIVE, help="end after this time [s]  [default: Ctrl-C]")
@click.option("--loop", is_flag=True, help="start again with the first frame after the last")
@click.option("--ahead", type=click.IntRange(min=1), help="pulses kept in memory  [default: as many as 1 GiB holds]")
@click.option("--loss", type=SHARE, default=0.0, help="share of stream packets that are lost")
@click.option("--withhold", type=SHARE, default=0.0, help="share of trigger pulses that do not reach a camera")
@click.option("--reboot", "reboots", multiple=True, metavar="CAMERA@S", help="this camera reboots after S seconds")
@click.option("--drift", type=Number(), default=0.0, metavar="PPM", help="the clocks drift from -PPM to +PPM")
@click.option("--seed", type=click.IntRange(min=0), default=0, help="seed of the losses and of the stream's faults")
@click.option("--switchover", is_flag=True, help="cameras can be taken over with a key (control switchover)")
@click.option(
    "--rig-out", type=OUT_FILE, help="write a rig file with which 'mosca capture --rig' records these cameras"
)
@click.option(
    "--trigger",
    type=click.Choice(["Line1", "serial", "Software", "Action1", "Off"]),
    default="Line1",
    show_default=True,
    help="trigger of the cameras; serial: Line1, pulsed by an emulated generator on a serial port",
)
@click.option("--workers", type=click.IntRange(1, 64), help="rendering threads  [default: all cores]")
@stream_options(None, "--stream-address")
@click.option(
    "--tracks",
    type=FILE,
    help="tracks to stream: a run folder, or a file whose frames are pulses  [default: the truth]",
)
@fault_options
def twin_serve(**given: Any) -> None:
    """Serve virtual cameras or a recording as GigE Vision cameras, for any client of the standard.

    WHAT is a scenario (file or name), a recording, or a rig file whose [twin] table names one of them. Pulses on the
    trigger line begin, with pulse 0 and frame 0, once all cameras acquire, and stop when no camera acquires. With
    --stream each pulse also sends the markers and bodies of that instant, on the same clock (docs/streams.md).

    \b
    Example:  mosca twin serve subjects/drone --seconds 60 --rig-out served.toml
              mosca twin serve subjects/drone --rig-out served.toml --stream natnet --stream lsl
              mosca twin serve subjects/drone --stream natnet --fault latency=0.03@5+2 --fault body-lost@10+1
    """
    from scenarios.lab.serve import serve

    streams, axis = stream_settings(given)
    request = _serve_request(**given, streams=streams, up=axis)
    with Progress("rendering ahead") as shown:
        up = serve(request, shown, _tell, click.echo)
    print_table(_counts(up))


def _serve_request(
    *,
    rate: float | None,
    loss: float,
    withhold: float,
    reboots: tuple[str, ...],
    drift: float,
    seed: int,
    workers: int | None,
    **same_name: Any,
) -> "ServeRequest":
    from scenarios.lab.serve import InjectedFaults, ServeRequest

    faults = InjectedFaults(loss, withhold, drift, dict(_reboot(text) for text in reboots), seed)
    return ServeRequest(rate_hz=rate, trouble=faults, workers=workers or os.cpu_count() or 1, **same_name)


def _reboot(text: str) -> tuple[str, float]:
    camera, _, seconds = text.rpartition("@")
    if not camera or not re.fullmatch(r"\d+(\.\d*)?", seconds):
        raise InputError(f"--reboot {text}: CAMERA@SECONDS is wanted, for example --reboot cam0@5")
    return camera, float(seconds)


def _tell(up: "Served") -> None:
    """Print the served devices and their addresses."""
    shown = table("camera", "address", "serial", "size", "format", "exposure")
    for device in up.devices:
        who = device.identity
        shown.add_row(
            who.name,
            str(who.address.ip),
            who.serial,
            f"{who.width}x{who.height}",
            f"{who.bit_depth} bit",
            f"{who.exposure_us:g} us",
        )
    print_table(shown)
    sys.stdout.flush()


def _counts(up: "Served") -> Any:
    """Return a table of the counts of pulses and packets."""
    columns = {
        "pulses": "pulses",
        "withheld": "withheld",
        "ignored": "ignored",
        "frames sent": "frames",
        "packets sent": "packets_sent",
        "lost": "packets_lost",
        "resent": "packets_resent",
        "reboots": "reboots",
    }
    shown = table("camera", *columns)
    for device in up.devices:
        counts = device.counts()
        shown.add_row(device.identity.name, *(str(counts.get(key, 0)) for key in columns.values()))
    return shown
