"""The verbs for rigs of several PCs: station detect, station reconstruct, station rig."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mosca.errors import InputError
from scenarios.cli.options import FILE, OUT_FILE, POSITIVE, SET, Number, echo_lines

if TYPE_CHECKING:
    from hardware.transport import Trust

SETTINGS_HELP = "TOML file with [detection], [match], [track] and [volume]"


LISTEN_HELP = "endpoint to listen on, with the address of the interface, e.g. tcp/10.0.0.1:7447"


def _trusted(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that select whose messages are accepted."""
    for option in (
        click.option(
            "--insecure",
            is_flag=True,
            help="accept messages of every program; only for a network of the stations' own",
        ),
        click.option(
            "--key",
            type=FILE,
            help="key file that all stations share; without it only endpoints of this PC can be used",
        ),
    ):
        command = option(command)
    return command


def _trust(key: Path | None, insecure: bool) -> "Trust":
    from hardware.transport import Trust
    from hardware.transport.signed import read_key

    if key is not None and insecure:
        raise InputError(f"--key {key} and --insecure given; leave one of them out")
    return Trust(None if key is None else read_key(key), insecure)


@click.group()
def station() -> None:
    """Use more cameras on several PCs: stations detect, one station reconstructs (docs/stations.md)."""


@station.command("detect")
@click.option("--rig", required=True, type=FILE, help="rig file (TOML) with this station's cameras")
@click.option("--name", required=True, help="this station's name, e.g. A")
@click.option(
    "--connect", required=True, multiple=True, help="endpoint of the reconstructing station, e.g. tcp/10.0.0.1:7447"
)
@click.option("--recording", type=FILE, help="play this recording instead of opening the cameras")
@click.option("--fps", type=POSITIVE, help="frame rate of a recording that does not state its own [Hz]")
@click.option("--seconds", type=POSITIVE, help="end after this time [s]  [default: Ctrl-C]")
@click.option("--settings", type=FILE, help=SETTINGS_HELP)
@_trusted
@SET
def detect(
    rig: Path,
    name: str,
    connect: tuple[str, ...],
    recording: Path | None,
    fps: float | None,
    seconds: float | None,
    settings: Path | None,
    key: Path | None,
    insecure: bool,
    overrides: tuple[str, ...],
) -> None:
    """Detect targets in the images of this PC's cameras, and send the detections.

    \b
    Example:  mosca station detect --rig left.toml --name A --connect tcp/10.0.0.1:7447 --key rig.key
    """
    from scenarios.lab.station_verbs import detect_on_station

    trust = _trust(key, insecure)
    echo_lines(detect_on_station(rig, name, connect, recording, fps, seconds, settings, overrides, trust, click.echo))


@station.command("reconstruct")
@click.option("--rig", required=True, type=FILE, help="rig file (TOML) with the cameras of all stations")
@click.option("--stations", required=True, help="names of the stations, e.g. A,B")
@click.option("--listen", required=True, multiple=True, help=LISTEN_HELP)
@click.option("--out", required=True, type=OUT_FILE, help="tracks: .npz, .csv, .parquet, .c3d or .trc")
@click.option("--seconds", type=POSITIVE, help="end after this time [s]  [default: when all stations end]")
@click.option(
    "--deadline-ms",
    type=Number(0, 10_000),
    default=30.0,
    show_default=True,
    help="longest time that a frame set waits for its cameras",
)
@click.option("--settings", type=FILE, help=SETTINGS_HELP)
@_trusted
@SET
def reconstruct(
    rig: Path,
    stations: str,
    listen: tuple[str, ...],
    out: Path,
    seconds: float | None,
    deadline_ms: float,
    settings: Path | None,
    key: Path | None,
    insecure: bool,
    overrides: tuple[str, ...],
) -> None:
    """Merge the detections of stations into tracks. Exit code 1 where a camera is missing in any frame set.

    \b
    Example:  mosca station reconstruct --rig all.toml --stations A,B --listen tcp/10.0.0.1:7447 --key rig.key
                  --out take.csv
    """
    from scenarios.lab.station_verbs import reconstruct_stations

    names = tuple(part.strip() for part in stations.split(",") if part.strip())
    lines, whole = reconstruct_stations(
        rig, names, listen, out, seconds, deadline_ms * 1e-3, settings, overrides, _trust(key, insecure), click.echo
    )
    echo_lines(lines)
    sys.exit(0 if whole else 1)


@station.command("rig")
@click.option("--of", "name", default="reconstruct", show_default=True, help="the station whose rig file is wanted")
@click.option(
    "--connect", required=True, multiple=True, help="endpoint of that station, or of the reconstructing station"
)
@click.option("--out", required=True, type=OUT_FILE, help="rig file to write")
@_trusted
def rig_of(name: str, connect: tuple[str, ...], out: Path, key: Path | None, insecure: bool) -> None:
    """Fetch a station's rig file with its calibration.

    \b
    Example:  mosca station rig --connect tcp/10.0.0.1:7447 --key rig.key --out all.toml
    """
    from hardware.transport import open_transport
    from hardware.transport.transport import check_station, key_of
    from mosca.data.files.whole_file import check_writable, whole_file

    topic = key_of(check_station(name), "rig")
    check_writable(out)
    transport = open_transport(connect, trust=_trust(key, insecure))
    try:
        text, until = None, time.monotonic() + 5.0
        while text is None and time.monotonic() < until:
            text = transport.query(topic, b"", 1.0)
            time.sleep(0.1)
    finally:
        transport.close()
    if text is None:
        raise InputError(f"station '{name}' does not answer at {', '.join(connect)}; is it running?")
    with whole_file(out) as temporary:
        temporary.write_bytes(text)
    click.echo(f"{out}")


@station.command("key")
@click.argument("file", type=FILE)
def make_key(file: Path) -> None:
    """Make the key that all stations of a rig share; copy FILE to each of them.

    \b
    Example:  mosca station key rig.key
    """
    from hardware.transport.signed import write_key

    write_key(file)
    click.echo(f"{file}: copy it to every station, and give it as --key")
