"""The verbs that make tracks and name them: reconstruct, labels, bodies, zones."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import click

from mosca.errors import InputError
from scenarios.cli.options import FILE, LAG, OUT_FILE, POSITIVE, SET, echo_lines
from scenarios.cli.progress import Progress


@dataclass(frozen=True)
class ReconstructOptions:
    """The options of ``mosca reconstruct``, under their names."""

    recording: Path
    rig: Path
    out: Path
    fps: float | None
    settings: Path | None
    overrides: tuple[str, ...]
    labels: Path | None
    fill: float | None
    lag: int | None
    continuous: bool
    rate: float | None
    clocks: Literal["auto", "common", "own"] | None
    search: float | None
    worn: Path | None

    def run(self, progress: Callable[[int, int | None], None]) -> list[str]:
        """Reconstruct and return the lines to print; InputError where options exclude each other."""
        recording = (self.recording, self.rig, self.out, self.fps, self.settings, self.overrides)
        if self.continuous:
            from scenarios.commands.reconstruct_continuous import ContinuousOptions, reconstruct_continuous

            _exclude("--continuous", {"--labels": self.labels, "--fill": self.fill, "--lag": self.lag})
            if self.worn is not None:
                _exclude("--worn, whose cameras are of one clock", {"--clocks": self.clocks, "--search": self.search})
            search_s = 10.0 if self.search is None else self.search
            options = ContinuousOptions(self.rate, self.clocks or "auto", search_s, worn=self.worn)
            return reconstruct_continuous(*recording, options, progress)
        _exclude(
            "a run without --continuous",
            {"--rate": self.rate, "--clocks": self.clocks, "--search": self.search, "--worn": self.worn},
        )
        from scenarios.commands.reconstruct import reconstruct_recording
        from scenarios.run.postprocess import Postprocessing

        after = Postprocessing(self.lag, self.labels, self.fill)
        return reconstruct_recording(*recording, progress, after)


def _exclude(what: str, options: dict[str, object]) -> None:
    """Raise InputError where one of ``options`` is given that cannot be combined with ``what``."""
    for name, given in options.items():
        if given is not None:
            raise InputError(f"{name} does not go with {what}; leave one of them out")


@click.command()
@click.argument("recording", type=FILE)
@click.option("--rig", required=True, type=FILE, help="rig file (TOML; also aniposelib, Caliscope, Pose2Sim)")
@click.option("--out", required=True, type=OUT_FILE, help="tracks: .npz, .csv, .parquet, .c3d or .trc")
@click.option("--fps", type=float, help="frame rate of a recording that does not state its own [Hz]")
@click.option("--settings", type=FILE, help="TOML file with [background], [detection], [match], [track] and [volume]")
@SET
@click.option("--labels", type=FILE, help="marker model that names the tracks; 'mosca labels learn' makes one")
@click.option(
    "--fill",
    type=float,
    metavar="SECONDS",
    help="fill gaps up to this length; filled samples are marked and have their own uncertainty",
)
@LAG
@click.option(
    "--continuous",
    is_flag=True,
    help="cameras that are not synchronised: each frame at its own instant, trajectories as functions of time",
)
@click.option("--rate", type=float, help="with --continuous: samples a second  [default: the fastest camera's rate]")
@click.option(
    "--clocks",
    type=click.Choice(["auto", "common", "own"]),
    help="with --continuous: whether all stamps are of one clock  [default: auto, as the recording states]",
)
@click.option(
    "--search",
    type=float,
    help="with --continuous: largest difference of the cameras' start times [s]  [default: 10]",
)
@click.option(
    "--worn",
    type=FILE,
    metavar="LAMPS.toml",
    help="with --continuous: cameras are worn on limbs and carry lamps that blink numbers; poses are estimated "
    "from these",
)
def reconstruct(**given: Any) -> None:
    """Reconstruct tracks from a recording of real (or rendered) images.

    \b
    Example:  mosca reconstruct lab/take1 --rig rig.toml --out take1.csv --fps 100 --fill 0.2

    \b
    Cameras that are not synchronised, each on a clock of its own:
              mosca reconstruct lab/take2 --rig rig.toml --out take2.csv --continuous --clocks own --rate 100

    \b
    Cameras on the limbs of a person, which see each other's lamps:
              mosca reconstruct lab/take3 --rig rig.toml --out take3.csv --continuous --worn lamps.toml
    """
    options = ReconstructOptions(**given)
    with Progress(options.recording.name) as shown:
        lines = options.run(shown)
    echo_lines(lines)


@click.group()
def labels() -> None:
    """Label tracks: learn a subject's marker model, and name tracks by a model, a template or codes."""


@labels.command()
@click.argument("tracks", type=FILE)
@click.option("--out", required=True, type=OUT_FILE, help="marker model to write: .toml")
@click.option(
    "--name", "names", multiple=True, metavar="TRACK=LABEL", help="name a track, e.g. 7=LFHD, where the file does not"
)
@click.option(
    "--limb",
    "limbs",
    multiple=True,
    metavar="LIMB=LABEL,...",
    help="markers that move as one body, e.g. head=LFHD,RFHD,LBHD; then a static pose is enough",
)
@click.option(
    "--frames",
    metavar="FIRST:LAST",
    help="learn only from these frames, in which every name is right  [default: all]",
)
def learn(tracks: Path, out: Path, names: tuple[str, ...], limbs: tuple[str, ...], frames: str | None) -> None:
    """Learn a marker model from a stretch of tracks whose labels are known.

    \b
    Example:  mosca labels learn take1.csv --name 0=LFHD --name 3=RFHD --name 4=C7 --out model.toml
    """
    from scenarios.commands.labels import learn_from

    click.echo(learn_from(tracks, out, names, limbs, frames))


@labels.command()
@click.argument("tracks", type=FILE)
@click.option("--model", required=True, type=FILE, help="marker model: .toml")
@click.option(
    "--out", required=True, type=OUT_FILE, help="the same tracks with labels: .npz, .csv, .parquet, .c3d or .trc"
)
@click.option("--fps", type=POSITIVE, help="frame rate to state in .c3d and .trc  [default: from the samples' times]")
def apply(tracks: Path, model: Path, out: Path, fps: float | None) -> None:
    """Name the tracks of a file by a marker model.

    \b
    Example:  mosca labels apply take2.csv --model model.toml --out take2.c3d
    """
    from scenarios.commands.labels import apply_to

    echo_lines(apply_to(tracks, model, out, fps))


@labels.command()
@click.argument("tracks", type=FILE)
@click.option(
    "--out", required=True, type=OUT_FILE, help="the same tracks with labels: .npz, .csv, .parquet, .c3d or .trc"
)
@click.option(
    "--set",
    "set_name",
    metavar="NAME|FILE.toml",
    help="marker set: plug-in-gait, cmu, face, or a file of a template or a surface model  [default: many markers of "
    "a body, of which any may be absent]",
)
@click.option(
    "--static", type=FILE, help="labelled take of this person with these markers, a static pose for instance"
)
@click.option("--model", type=OUT_FILE, help="write the marker model of this person: .toml, for 'mosca labels apply'")
@click.option("--probabilities", type=OUT_FILE, help="write the probability of each sample's label: .csv")
@click.option("--fps", type=POSITIVE, help="frame rate to state in .c3d and .trc  [default: from the samples' times]")
def auto(
    tracks: Path,
    out: Path,
    set_name: str | None,
    static: Path | None,
    model: Path | None,
    probabilities: Path | None,
    fps: float | None,
) -> None:
    """Name the tracks of a person or a face by a template, without training; a static pose is optional.

    \b
    Example:  mosca labels auto take2.c3d --set plug-in-gait --out named.c3d
    """
    from scenarios.commands.labels_auto import label_auto

    echo_lines(label_auto(tracks, out, set_name, static, model, probabilities, fps))


@labels.command()
@click.argument("tracks", type=FILE)
@click.option(
    "--out", required=True, type=OUT_FILE, help="the same tracks with labels: .npz, .csv, .parquet, .c3d or .trc"
)
@click.option(
    "--name",
    "names",
    multiple=True,
    metavar="NUMBER=LABEL",
    help="label of a lamp  [default: lamp/NUMBER for all lamps]",
)
@click.option(
    "--frames-per-bit", type=click.IntRange(min=1), default=1, show_default=True, help="length of a bit in pulses"
)
@click.option("--in-step", is_flag=True, help="bit 0 begins at pulse 0  [default: at an unknown pulse]")
@click.option("--fps", type=POSITIVE, help="frame rate to state in .c3d and .trc  [default: from the samples' times]")
def blink(
    tracks: Path, out: Path, names: tuple[str, ...], frames_per_bit: int, in_step: bool, fps: float | None
) -> None:
    """Name the tracks of active markers by their blink codes.

    \b
    Example:  mosca labels blink take3.csv --name 0=LWRI --name 1=RWRI --out take3.c3d
    """
    from mosca.labelling.blinking_leds import BlinkSettings
    from scenarios.commands.labels import label_blinking

    settings = BlinkSettings(frames_per_bit=frames_per_bit, in_step=in_step)
    echo_lines(label_blinking(tracks, out, settings, names, fps))


@labels.command()
@click.argument("recording", type=FILE)
@click.option("--rig", required=True, type=FILE, help="calibrated rig file")
@click.option(
    "--out", required=True, type=OUT_FILE, help="tracks, labelled code/NUMBER: .npz, .csv, .parquet, .c3d or .trc"
)
@click.option("--fps", type=POSITIVE, help="frame rate of a recording that does not state its own [Hz]")
@click.option(
    "--colour",
    type=click.Choice(["white", "black", "both"]),
    default="white",
    show_default=True,
    help="colour of dots and sectors",
)
def coded(
    recording: Path, rig: Path, out: Path, fps: float | None, colour: Literal["white", "black", "both"]
) -> None:
    """Track coded targets; the number of each target gives its identity and its correspondence.

    \b
    Example:  mosca labels coded lab/take4 --rig rig.toml --out take4.csv
    """
    from mosca.coded_targets.detect import CodedSettings
    from scenarios.commands.labels import label_coded

    settings = CodedSettings(colour=colour)
    with Progress(recording.name) as shown:
        lines = label_coded(recording, rig, out, fps, settings, shown)
    echo_lines(lines)


@click.group()
def bodies() -> None:
    """Learn rigid bodies from tracks, and find their poses (6 degrees of freedom) in other tracks."""


@bodies.command("learn")
@click.argument("tracks", type=FILE)
@click.option("--out", required=True, type=OUT_FILE, help="definitions to write: .toml")
@click.option(
    "--body",
    "named",
    multiple=True,
    required=True,
    metavar="NAME=TRACK,...",
    help="the tracks of a body's markers, e.g. drone=0,3,4,7",
)
@click.option("--frames", metavar="FIRST:LAST", help="learn only from these frames  [default: all]")
def learn_bodies(tracks: Path, out: Path, named: tuple[str, ...], frames: str | None) -> None:
    """Learn rigid bodies from a stretch of tracks that shows all their markers.

    A body that is symmetric, or too similar to another one, is refused.

    \b
    Example:  mosca bodies learn take1.csv --body drone=0,3,4,7 --out bodies.toml
    """
    from scenarios.commands.bodies import learn_from

    echo_lines(learn_from(tracks, out, named, frames))


@bodies.command("find")
@click.argument("tracks", type=FILE)
@click.option("--bodies", "definitions", required=True, type=FILE, help="their definitions: .toml")
@click.option("--out", required=True, type=OUT_FILE, help="poses: .csv with covariances, or .tum of one body")
@click.option("--body", metavar="NAME", help="find only this body  [default: all; .tum: the only one]")
@click.option("--tracks-out", type=OUT_FILE, help="the same tracks, labelled by their bodies")
@click.option("--fps", type=POSITIVE, help="frame rate to state in .c3d and .trc  [default: from the times]")
def find_bodies(
    tracks: Path, definitions: Path, out: Path, body: str | None, tracks_out: Path | None, fps: float | None
) -> None:
    """Find the poses of rigid bodies in tracks, with covariances; uncertain poses are withheld.

    \b
    Example:  mosca bodies find take2.csv --bodies bodies.toml --out poses.csv
    """
    from scenarios.commands.bodies import find_in

    echo_lines(find_in(tracks, definitions, out, body, tracks_out, fps))


@click.command()
@click.argument("tracks", nargs=-1, required=True, type=FILE)
@click.option("--out", required=True, type=OUT_FILE, help="one set of tracks: .npz, .csv, .parquet, .c3d or .trc")
@click.option("--fps", type=POSITIVE, help="frame rate to state in .c3d and .trc  [default: from the samples' times]")
def zones(tracks: tuple[Path, ...], out: Path, fps: float | None) -> None:
    """Stitch the tracks of several zones into one set; all share the same pulses and the same world frame.

    A shift between the zones' frames is measured where they overlap, reported and corrected; the first file's frame
    is the reference.

    \b
    Example:  mosca zones left.csv right.csv --out hall.csv
    """
    if len(tracks) < 2:
        raise InputError(f"zones: {len(tracks)} file of tracks given; 2 or more are to be stitched")
    from scenarios.commands.zones import stitch_files

    echo_lines(stitch_files(tracks, out, fps))
