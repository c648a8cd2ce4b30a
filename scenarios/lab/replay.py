"""``mosca replay``: tracks and poses of bodies from files as a stream, at their own pace, with faults on demand."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from hardware.streams.content import TakeFrames, UpAxis
from hardware.streams.fault_line import FaultLine
from hardware.streams.faults import StreamFaults, fault_of, read_faults
from hardware.streams.natnet.server import NatNetServer
from hardware.streams.natnet.settings import NatNetSettings
from hardware.streams.play import StreamPlayer, account_lines, address_line, looped
from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.bodies.bodies_csv import read_bodies_csv
from mosca.formats.bodies.body_file import read_bodies
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.rigid_bodies.tracker import body_poses, labelled_by_bodies
from scenarios.run.interrupt import first_ctrl_c
from scenarios.run.take_files import take_files

LOOK_S = 0.02


@dataclass(frozen=True)
class ReplayRequest:
    """Arguments of ``mosca replay``."""

    tracks: Path
    settings: NatNetSettings
    up: UpAxis = "z"
    bodies: Path | None = None
    speed: float | None = 1.0
    """How many times as fast as measured; None: as fast as possible."""
    loop: bool = False
    seconds: float | None = None
    wait: int = 0
    fault: tuple[str, ...] = ()
    faults: Path | None = None
    seed: int | None = None


def replay_tracks(request: ReplayRequest, report: Callable[[str], None]) -> list[str]:
    """Stream until the take is over, ``seconds`` have passed or Ctrl-C; return the account's lines.

    ``report`` is called with the line that says where. InputError for files, options and faults that cannot be.
    """
    faults = _faults(request)
    frames = _take(request)
    period_s = 1.0 / frames.rate_hz
    line = FaultLine(faults, frames.model, frames.numbers) if faults.program else None
    settings = replace(request.settings, rate_hz=frames.rate_hz)
    with NatNetServer(frames.model, settings) as server:
        player = StreamPlayer(server, line, request.speed)
        with first_ctrl_c(player.stop):
            report(address_line(server))
            report(f"{request.tracks}: {len(frames)} frames at {frames.rate_hz:.6g} Hz; {_content(frames)}")
            while server.connected() < request.wait and not player.stopped:
                time.sleep(LOOK_S)
            begin = time.monotonic()
            player.play(looped(frames, period_s) if request.loop else frames, period_s, request.seconds)
            elapsed = time.monotonic() - begin
    return account_lines(player, elapsed, line)


def _content(frames: TakeFrames) -> str:
    names = ", ".join(frames.body_names[:12]) or "none"
    return f"{len(frames.numbers)} labels, bodies: {names}"


def _faults(request: ReplayRequest) -> StreamFaults:
    given = StreamFaults() if request.faults is None else read_faults(request.faults)
    named = tuple(fault_of(text) for text in request.fault)
    seed = given.seed if request.seed is None else request.seed
    return StreamFaults(seed=seed, program=(*given.program, *named))


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
    return TakeFrames(tracks, poses, bodies, request.up)


def _with_bodies(tracks: Tracks, path: Path) -> tuple[Tracks, BodyPoses, tuple[RigidBody, ...]]:
    """Return the tracks, named by the bodies that they belong to, and the bodies' poses and definitions."""
    if path.suffix.lower() == ".csv":
        return tracks, read_bodies_csv(path), ()
    bodies = read_bodies(path)
    return labelled_by_bodies(tracks, bodies), body_poses(tracks, bodies), bodies
