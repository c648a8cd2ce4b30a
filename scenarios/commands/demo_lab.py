"""``mosca demo lab``: the data of a lab after a day's work, made by the twin; the truth is kept apart.

The lab has a calibration session as folders of images, a take as recorded by ``mosca capture``, the files that
describe the target, and a scenario that judges the reconstruction. The commands that calibrate, reconstruct and judge
are in the lab's README.md; they do not use the twin.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from mosca.data.files.rig_file import write_rig
from mosca.data.files.target_text import target_toml
from mosca.data.files.whole_file import whole_folder, write_text
from mosca.data.rig import Rig
from mosca.data.truth import write_truth
from mosca.errors import InputError
from mosca.recording.image_folders import write_image_folders
from mosca.recording.writer import RecordingWriter
from scenarios.build.cameras import true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.session.estimated import at_rest, session_source
from scenarios.session.scenes import Session, axes_session, bar_session, target_session
from scenarios.spec.scenario import Scenario
from twin.cameras.virtual_camera import VirtualCamera

NOT_OF_THE_TAKE = {"premises", "skeleton", "breaks", "told", "calibration"}
"""Tables of a scenario that do not concern the frames of its take, or that concern the rig to be calibrated."""
NEEDS_COVARIANCE = {"nees", "coverage95", "calibration_volume_rms", "calibration_rays_rms"}
"""Limits on values that only a calibration in the same run has: its own covariance, its errors."""
Progress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class DemoLab:
    """A written lab: ``commands`` (n) in their order, as in the lab's README."""

    folder: Path
    images: int
    frames: int
    commands: tuple[str, ...]


def write_demo_lab(
    spec: Scenario, source_folder: Path, out: Path, workers: int, progress: Progress | None = None
) -> DemoLab:
    """Render the calibration session and the take of ``spec`` into the folder ``out``, which appears when whole.

    Parameters
    ----------
    spec
        A scenario with a ``[calibration]``.
    source_folder
        Folder to which its file names are relative.
    out
        A folder that does not exist yet.
    workers
        Rendering threads.
    progress
        Called with (images done, all images).

    Raises
    ------
    InputError
        Where ``out`` exists or cannot be written, or the scenario has no calibration target, or a fault in it.
    """
    wanted = spec.calibration
    if wanted is None or wanted.target == "none" or wanted.fault is not None or wanted.exterior_only:
        raise InputError(
            "the scenario's cameras are not calibrated from nothing, with a target that is as its file says; add a "
            "[calibration] without fault and exterior_only, or choose another scenario ('mosca list')"
        )
    rig = true_rig(spec, source_folder)
    cameras = virtual_cameras(spec, rig)
    scene = build_scene(spec, source_folder)
    pixels = sum(one.camera.width * one.camera.height for one in cameras)
    report = progress or (lambda done, total: None)
    with whole_folder(out, 2 * pixels * spec.capture.pulses) as part:
        sessions, still = _sessions(spec), at_rest(cameras)
        pulses = sum(session.pulses for session in sessions.values())
        total = pulses * len(still) + spec.capture.pulses * len(cameras)
        images = frames = 0

        def written(more: int) -> None:
            report(images + more, total)

        for k, (name, session) in enumerate(sessions.items()):
            write_text(part / f"{name}.toml", target_toml(session.target))
            with session_source(spec, session, still, workers, k) as source:
                images += write_image_folders(source, part / name, written)
        (part / "truth").mkdir()
        with twin_source(spec, scene, cameras, workers) as twin:
            with RecordingWriter(part / "take", twin.cameras) as writer:
                for frame in twin:
                    writer.write(frame)
                    frames += 1
                    written(frames)
            write_truth(twin.truth(), part / "truth" / "truth.npz")
        write_rig(rig, part / "truth" / "rig.toml")
        write_text(part / "check.toml", _check_toml(spec, source_folder))
        commands = _commands(out, list(sessions), cameras)
        write_text(part / "README.md", _readme(out, spec, rig, list(sessions), commands))
    return DemoLab(out, images, frames, commands)


def _sessions(spec: Scenario) -> dict[str, Session[Any]]:
    """Return the sessions before the cameras, by the name of their folder, in the order of recording."""
    assert spec.calibration is not None
    target = spec.calibration.target
    sessions: dict[str, Session[Any]] = {target: target_session(spec, spec.calibration)}
    if target != "field":
        sessions["l_frame"] = axes_session(spec)
    if spec.calibration.lengths:
        sessions["bar"] = bar_session(spec)
    return sessions


def _commands(out: Path, sessions: list[str], cameras: tuple[VirtualCamera, ...]) -> tuple[str, ...]:
    main = sessions[0]
    calibrate = f"mosca calibrate {out}/{main} --target {out}/{main}.toml"
    if "l_frame" in sessions:
        calibrate += f" --axes {out}/l_frame {out}/l_frame.toml"
    if "bar" in sessions:
        calibrate += f" --lengths {out}/bar {out}/bar.toml"
    pitch = {one.optics.pixel_pitch_mm for one in cameras}
    if len(pitch) == 1:
        calibrate += f" --pixel-pitch-mm {pitch.pop():g}"
    return (
        f"{calibrate} --out {out}/rig.toml",
        f"mosca rig check {out}/rig.toml",
        f"mosca reconstruct {out}/take --rig {out}/rig.toml --out {out}/take.csv",
        f"mosca tracks page {out}/take.csv {out}/take.html --rig {out}/rig.toml",
        f"mosca run {out}/check.toml --source recording:{out}/take --truth {out}/truth/truth.npz --out {out}/check",
        f"mosca rig compare {out}/rig.toml {out}/truth/rig.toml",
    )


def _check_toml(spec: Scenario, source_folder: Path) -> str:
    """Return a scenario that judges the take, measured with the rig file of the calibration beside it.

    The files of the scene are not copied; they stay in ``source_folder``.
    """
    document = spec.model_dump(mode="json", exclude_unset=True, exclude=NOT_OF_THE_TAKE)
    document["title"] = f"{spec.title} (from this lab's images)"
    document["cameras"] = {"rig": "rig.toml"}
    for key, value in document["scene"].items():
        if isinstance(value, str) and (file := source_folder / value).is_file():
            document["scene"][key] = str(file.resolve())
    document["limits"] = {
        key: value for key, value in document.get("limits", {}).items() if key not in NEEDS_COVARIANCE
    }
    return tomli_w.dumps(document)


WHAT = {
    "field": "a test field: coded targets at measured positions, shown at several stands",
    "board": "a checkerboard that is carried through the working space",
    "wand": "a wand with balls at known distances, waved through the working space",
    "l_frame": "an L-frame that defines the world's axes",
    "bar": "a certified scale bar that the calibration does not use: it checks the scale",
}


def _readme(out: Path, spec: Scenario, rig: Rig, sessions: list[str], commands: tuple[str, ...]) -> str:
    rows = [
        f"| `{name}/`, `{name}.toml` | {WHAT[name]}: images, and the file that describes it |" for name in sessions
    ]
    capture = spec.capture
    size = " x ".join(f"{edge:g}" for edge in spec.working_space.size_m)
    lines = [
        "# A lab without cameras",
        "",
        f"{spec.title}. {len(rig.cameras)} cameras, working space {size} m, rendered by the twin.",
        "",
        "| | |",
        "|---|---|",
        *rows,
        f"| `take/` | {capture.duration_s:g} s at {capture.frame_rate_hz:g} Hz, as `mosca capture` records |",
        "| `check.toml` | a scenario with the accuracy that is claimed, for your calibration |",
        "| `truth/` | the true trajectories and the true rig: look at them last |",
        "",
        "Nothing but `truth/` knows where the cameras are. From where `mosca demo lab` was called:",
        "",
        "```sh",
        *commands,
        "```",
        "",
        "They write the calibrated cameras (`rig.toml`, `rig.html`), trajectories with covariances (`take.csv`,",
        "`take.html`), the verdict against the truth (`check/report.html`), and how far rays and points of the two",
        "rigs are apart.",
        "",
    ]
    return "\n".join(lines)
