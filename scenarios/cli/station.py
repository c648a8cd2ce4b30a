"""The verbs for rigs of several PCs: station detect, station reconstruct, station rig."""

import sys
import time
from pathlib import Path

import click

from mosca.errors import InputError
from scenarios.cli.options import FILE, OUT_FILE, POSITIVE, SET, Number, echo_lines

SETTINGS_HELP = "TOML file with [detection], [match], [track] and [volume]"


@click.group()
def station() -> None:
    """More cameras by more PCs: stations detect, one reconstructs (docs/stations.md)."""


@station.command("detect")
@click.option("--rig", required=True, type=FILE, help="rig file (TOML) with this station's cameras")
@click.option("--name", required=True, help="this station's name, e.g. A")
@click.option(
    "--connect", required=True, multiple=True, help="where the reconstructing station is, e.g. tcp/10.0.0.1:7447"
)
@click.option("--recording", type=FILE, help="play this recording instead of opening the cameras")
@click.option("--fps", type=POSITIVE, help="frame rate of a recording that does not tell its own [Hz]")
@click.option("--seconds", type=POSITIVE, help="end after this  [default: Ctrl-C]")
@click.option("--settings", type=FILE, help=SETTINGS_HELP)
@SET
def detect(
    rig: Path,
    name: str,
    connect: tuple[str, ...],
    recording: Path | None,
    fps: float | None,
    seconds: float | None,
    settings: Path | None,
    overrides: tuple[str, ...],
) -> None:
    """Detect on this PC's cameras and send what is found.

    \b
    Example:  mosca station detect --rig left.toml --name A --connect tcp/10.0.0.1:7447
    """
    from scenarios.lab.station_verbs import detect_on_station

    echo_lines(detect_on_station(rig, name, connect, recording, fps, seconds, settings, overrides, click.echo))


@station.command("reconstruct")
@click.option("--rig", required=True, type=FILE, help="rig file (TOML) with the cameras of all stations")
@click.option("--stations", required=True, help="their names, e.g. A,B")
@click.option("--listen", required=True, multiple=True, help="endpoint to listen on, e.g. tcp/0.0.0.0:7447")
@click.option("--out", required=True, type=OUT_FILE, help="tracks: .npz, .csv, .c3d or .trc")
@click.option("--seconds", type=POSITIVE, help="end after this  [default: when all end]")
@click.option(
    "--deadline-ms",
    type=Number(0, 10_000),
    default=30.0,
    show_default=True,
    help="a set waits so long for its cameras",
)
@click.option("--settings", type=FILE, help=SETTINGS_HELP)
@SET
def reconstruct(
    rig: Path,
    stations: str,
    listen: tuple[str, ...],
    out: Path,
    seconds: float | None,
    deadline_ms: float,
    settings: Path | None,
    overrides: tuple[str, ...],
) -> None:
    """Merge what stations detect into tracks. Exit code 1 where a camera is missing in any set.

    \b
    Example:  mosca station reconstruct --rig all.toml --stations A,B --listen tcp/0.0.0.0:7447 --out take.csv
    """
    from scenarios.lab.station_verbs import reconstruct_stations

    names = tuple(part.strip() for part in stations.split(",") if part.strip())
    lines, whole = reconstruct_stations(
        rig, names, listen, out, seconds, deadline_ms * 1e-3, settings, overrides, click.echo
    )
    echo_lines(lines)
    sys.exit(0 if whole else 1)


@station.command("rig")
@click.option("--of", "name", default="reconstruct", show_default=True, help="the station whose rig file is wanted")
@click.option("--connect", required=True, multiple=True, help="where it, or the reconstructing station, is")
@click.option("--out", required=True, type=OUT_FILE, help="rig file to write")
def rig_of(name: str, connect: tuple[str, ...], out: Path) -> None:
    """Fetch a station's rig file with its calibration.

    \b
    Example:  mosca station rig --connect tcp/10.0.0.1:7447 --out all.toml
    """
    from hardware.transport import open_transport
    from hardware.transport.transport import check_station, key_of
    from mosca.data.files.whole_file import check_writable, whole_file

    key = key_of(check_station(name), "rig")
    check_writable(out)
    transport = open_transport(connect)
    try:
        text, until = None, time.monotonic() + 5.0
        while text is None and time.monotonic() < until:
            text = transport.query(key, b"", 1.0)
            time.sleep(0.1)
    finally:
        transport.close()
    if text is None:
        raise InputError(f"station '{name}' does not answer at {', '.join(connect)}; is it running?")
    with whole_file(out) as temporary:
        temporary.write_bytes(text)
    click.echo(f"{out}")
