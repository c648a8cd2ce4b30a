"""``mosca replay``: tracks and poses of bodies from files as a stream, at their own pace, with faults on demand."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hardware.streams.content import TakeFrames
from hardware.streams.fault_line import FaultLine
from hardware.streams.faults import ordered_faults
from hardware.streams.play import StreamPlayer, account_lines, looped
from hardware.streams.turns import UpAxis
from hardware.streams.values import StreamedSkeleton
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import read_bodies_csv
from mosca.formats.bodies.body_file import read_bodies
from mosca.formats.joints.angles_csv import read_angles_csv
from mosca.formats.joints.joints_csv import read_joints_csv
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.rigid_bodies.tracker import body_poses, labelled_by_bodies
from scenarios.run.interrupt import first_ctrl_c
from scenarios.run.priority import before_others, prompt
from scenarios.run.stream_servers import StreamSettings, check_wait, opened_streams
from scenarios.run.take_files import take_files

LOOK_S = 0.02


@dataclass(frozen=True)
class ReplayRequest:
    """Arguments of ``mosca replay``."""

    tracks: Path
    settings: tuple[StreamSettings, ...]
    up: UpAxis = "z"
    bodies: Path | None = None
    joints: Path | None = None
    angles: Path | None = None
    """Joint angles of a person, as written by 'mosca skeleton track'; default: those of a run folder."""
    speed: float | None = 1.0
    """Factor on the speed of the measurement; None: as fast as possible."""
    loop: bool = False
    seconds: float | None = None
    wait: int = 0
    fault: tuple[str, ...] = ()
    faults: Path | None = None
    seed: int | None = None


def replay_tracks(request: ReplayRequest, report: Callable[[str], None]) -> list[str]:
    """Stream until the take is over, ``seconds`` have passed or Ctrl-C; return the account's lines.

    ``report`` is called with a line on the addresses. InputError for files, options and faults that cannot be used.
    """
    check_wait(request.settings, request.wait)
    faults = ordered_faults(request.fault, request.faults, request.seed)
    frames = _take(request)
    period_s = 1.0 / frames.rate_hz
    line = FaultLine(faults, frames.model, frames.numbers) if faults.program else None
    with opened_streams(request.settings, frames.model, frames.names, frames.rate_hz) as server:
        player = StreamPlayer(server, line, request.speed)
        with before_others(), prompt(), first_ctrl_c(player.stop):
            report(server.where())
            report(f"{request.tracks}: {len(frames)} frames at {frames.rate_hz:.6g} Hz; {_content(frames)}")
            while server.connected() < request.wait and not player.stopped:
                time.sleep(LOOK_S)
            begin = time.monotonic()
            player.play(looped(frames, period_s) if request.loop else frames, period_s, request.seconds)
            elapsed = time.monotonic() - begin
    return account_lines(player, elapsed, line)


def _content(frames: TakeFrames) -> str:
    names = ", ".join(frames.body_names[:12]) or "none"
    person = [f"{len(one.bones)} bones" for one in frames.model if isinstance(one, StreamedSkeleton)]
    angles = [f"{len(frames.names.angles)} joint angles"] if frames.names.angles else []
    return ", ".join((f"{len(frames.numbers)} labels", *person, *angles, f"bodies: {names}"))


def _take(request: ReplayRequest) -> TakeFrames:
    files, poses = take_files(request.tracks), None
    bodies: tuple[RigidBody, ...] = ()
    if request.bodies is None and files.bodies is not None:
        poses = read_bodies_csv(files.bodies)
    tracks = read_tracks(files.tracks)
    if request.bodies is not None:
        tracks, poses, bodies = _with_bodies(tracks, request.bodies)
    if not len(tracks) and not (poses is not None and len(poses)):
        raise InputError(f"{files.tracks}: no tracks; there is nothing to stream")
    joints, angles = request.joints or files.joints, request.angles or files.angles
    return TakeFrames(
        tracks,
        poses,
        bodies,
        request.up,
        joints=None if joints is None else read_joints_csv(joints),
        angles=None if angles is None else read_angles_csv(angles),
    )


def _with_bodies(tracks: Tracks, path: Path) -> tuple[Tracks, BodyPoses, tuple[RigidBody, ...]]:
    """Return the tracks, named by the bodies to which they belong, and the bodies' poses and definitions."""
    if path.suffix.lower() == ".csv":
        return tracks, read_bodies_csv(path), ()
    bodies = read_bodies(path)
    return labelled_by_bodies(tracks, bodies), body_poses(tracks, bodies), bodies
