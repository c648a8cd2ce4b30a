"""Skeletons of people from files of labelled tracks: fitting to a take, and finding of joints in takes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import read_text
from mosca.data.files.rig_file import read_rig
from mosca.data.files.whole_file import check_writable, whole_file, write_text
from mosca.data.joint_angles import JointAngles
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.bodies.bvh_writer import write_bvh
from mosca.formats.bodies.mjcf_writer import write_mjcf
from mosca.formats.bodies.subject_file import check_subject_file, read_subject, write_subject
from mosca.formats.joints.angles_csv import write_angles_csv
from mosca.formats.joints.joints_c3d import write_joints_c3d
from mosca.formats.joints.joints_csv import write_joints_csv
from mosca.formats.joints.opensim import COORDINATES, write_mot, write_scale_set
from mosca.formats.tracks.marker_table import MOST_CELLS
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.skeleton.fit import FittedSubject, fit_subject
from mosca.skeleton.gait_events import heel_strikes
from mosca.skeleton.isb_angles import isb_angles
from mosca.skeleton.marker_frames import MarkerFrames, labels_of, marker_frames, short_label
from mosca.skeleton.mjcf import MOST_BYTES, compiled
from mosca.skeleton.model import HUMAN, SkeletonModel, model_from_mjcf
from mosca.skeleton.opensim_scales import gait2354_scales, scaled_bodies
from mosca.skeleton.start import size_of
from mosca.skeleton.track import FEWEST_MARKERS, SkeletonTake, motion_of, track_subject
from reports.joint_plots import angles_picture
from reports.plot_style import svg_file
from reports.viewer import RerunLog, check_rrd
from scenarios.commands.labels import between, rate_of
from scenarios.commands.skeleton_words import check_bodies, lengths, sigmas, untold
from scenarios.run.people import show_person

Report = Callable[[int, int | None], None]


@dataclass(frozen=True)
class Outputs:
    """Files that ``track_take`` writes, None for those not wanted; ``out`` is the table of joints."""

    out: Path | None = None
    angles: Path | None = None
    bvh: Path | None = None
    mot: Path | None = None
    c3d: Path | None = None
    plot: Path | None = None
    rrd: Path | None = None

    def check(self) -> None:
        """Raise InputError if no file is wanted, or one has a wrong suffix, is named twice or cannot be written."""
        suffixes = {
            "out": ".csv",
            "angles": ".csv",
            "bvh": ".bvh",
            "mot": ".mot",
            "c3d": ".c3d",
            "plot": ".svg",
            "rrd": ".rrd",
        }
        given = {name: path for name in suffixes if (path := getattr(self, name)) is not None}
        if not given:
            raise InputError(
                "skeleton track: nothing to write; give --out, --angles, --bvh, --mot, --c3d, --plot or --rrd with a "
                "file"
            )
        for name, path in given.items():
            if path.suffix.lower() != suffixes[name]:
                raise InputError(f"{path}: suffix '{path.suffix}' given; {suffixes[name]} is wanted here")
            check_writable(path)
        check_rrd(self.rrd)
        if len({path.resolve() for path in given.values()}) < len(given):
            raise InputError(
                f"{', '.join(map(str, given.values()))}: a file stands twice; each has a name of its own"
            )


@dataclass(frozen=True)
class Selection:
    """The part of a take to read: ``person``, with labels NAME:LABEL, and ``frames``, FIRST:LAST; None for all.

    ``rig``: file of the calibrated cameras that measured it, from which the errors shared by markers are derived.
    """

    person: str | None = None
    frames: str | None = None
    rig: Path | None = None

    def markers(self, tracks: Tracks, labels: Sequence[str]) -> MarkerFrames:
        """Return the markers called ``labels`` frame by frame; InputError where the rig does not state shake."""
        rig = None if self.rig is None else read_rig(self.rig)
        if rig is not None and not any(camera.shake_px for camera in rig.cameras):
            raise InputError(
                f"{self.rig}: no camera has shake_px, what it shakes by; 'mosca calibrate' finds and writes it; "
                "leave --rig out where it is not known"
            )
        found = marker_frames(tracks, labels, rig)
        if rig is not None and found.seen.any() and not found.shared.any():
            raise InputError(
                f"{self.rig}: no two of its cameras see the markers; give the rig that measured these tracks, or "
                "leave --rig out"
            )
        return found

    def read(self, path: Path) -> Tracks:
        """Return the labelled samples of the tracks in ``path``; InputError where there is none."""
        tracks = read_tracks(path)
        if self.frames is not None:
            tracks = between(tracks, self.frames)
        if not len(tracks):
            raise InputError(f"{path}: no samples" + (f" in frames {self.frames}" if self.frames else ""))
        tracks = tracks.select(tracks.label != "")
        if not len(tracks):
            raise InputError(
                f"{path}: no track has a label; 'mosca labels auto' names the markers of a person, 'mosca labels "
                "apply' those of a model learned before"
            )
        if self.person is None:
            return tracks
        names = np.unique(tracks.label).tolist()
        mine = [name for name in names if name.startswith(f"{self.person}:")]
        if not mine:
            people = sorted({name.rsplit(":", 1)[0] for name in names if ":" in name})
            raise InputError(
                f"--person {self.person}: {path} has {', '.join(people[:8]) or 'labels without a person'}; "
                + ("name one of them" if people else "leave --person out")
            )
        return tracks.select(np.isin(tracks.label, mine))


def fit_take(
    path: Path,
    out: Path,
    model_path: Path | None,
    mjcf: Path | None,
    selection: Selection,
    progress: Report,
    osim_scale: Path | None = None,
) -> list[str]:
    """Fit a skeleton to the labelled tracks in ``path``, write the subject to ``out``; return the lines to print.

    ``model_path``: MJCF of the model, None for that of a person; ``mjcf``: file for the fitted model, None for none;
    ``osim_scale``: file for the scale set of OpenSim's gait2354.
    """
    check_subject_file(out)
    for file, kind in ((mjcf, "a model"), (osim_scale, "a scale set")):
        if file is None:
            continue
        if file.suffix.lower() != ".xml":
            raise InputError(f"{file}: suffix '{file.suffix}' given; {kind} is an .xml file")
        check_writable(file)
    if mjcf is not None and osim_scale is not None and mjcf.resolve() == osim_scale.resolve():
        raise InputError(f"{mjcf}: stands twice; each file has a name of its own")
    tracks = selection.read(path)
    model, unknown = _model(model_path or HUMAN, labels_of(tracks), path)
    _check_single(tracks, model.labels, path)
    if osim_scale is not None and not scaled_bodies(model):
        raise InputError(
            f"{osim_scale}: the model has no hips, knees or ankles (l_hip, ...) that would scale "
            "gait2354; leave --osim-scale out"
        )
    frames = selection.markers(tracks, model.labels)
    subject = fit_subject(model, frames, str(path), progress)
    lines = [f"{len(model.labels)} markers used: {', '.join(model.labels)}"]
    if unknown:
        lines.append(f"not known to the model: {', '.join(unknown)}")
    whose = "a person of 1.75 m" if model_path is None else "the model as it was given"
    lines.append(f"size: {subject.size:.3f} of {whose}")
    lines.append(f"residuals: {1e3 * subject.residual_rms_m:.3g} mm rms of {subject.frames} frames")
    lines += lengths(subject)
    lines += untold(subject, frames)
    write_subject(subject, out)
    if mjcf is not None:
        write_mjcf(subject, mjcf)
        lines.append(f"fitted model in {mjcf}")
    if osim_scale is not None:
        scales = gait2354_scales(subject)
        write_scale_set(scales, osim_scale)
        factors = ", ".join(f"{body} {one[0]:.3f}" for body, one in scales.items())
        lines.append(f"scale set for OpenSim's gait2354 in {osim_scale}: {factors}")
    return [*lines, f"subject in {out}"]


def track_take(
    path: Path,
    subject_path: Path,
    outputs: Outputs,
    selection: Selection,
    *,
    fps: float | None = None,
    heading_deg: float = 0.0,
    opensim: str = "Rajagopal",
    progress: Report = lambda done, total: None,
) -> list[str]:
    """Find the joints of a subject in the labelled tracks in ``path``, write ``outputs``; return the lines to print.

    ``heading_deg``: direction of progression in the world, to which pelvis angles refer; ``opensim``: the model for
    which the .mot file is written.
    """
    outputs.check()
    subject = read_subject(subject_path)
    check_bodies(subject, subject_path)
    tracks = selection.read(path)
    labels = labels_of(tracks)
    _check_known(labels, subject.model.labels, path, str(subject_path), "fit a subject to this set of markers")
    _check_single(tracks, subject.model.labels, path)
    frames = selection.markers(tracks, subject.model.labels)
    size_of(replace(subject.model, parameters=subject.parameters), frames, str(path))  # refuses another unit
    rate = rate_of(tracks, fps, path) if outputs.bvh or outputs.c3d else np.nan
    take = track_subject(subject, frames, progress)
    solved = np.isfinite(take.q[:, 0])
    if not solved.any():
        raise InputError(
            f"{path}: no frame shows {FEWEST_MARKERS} markers of {subject_path}; label more of the tracks"
        )
    writer = _Writer(path, subject, take, frames, tracks)
    written = writer.write(outputs, rate, heading_deg, opensim)
    rms = float(np.sqrt(np.nanmean(take.residual_m**2)))
    return [
        f"{int(solved.sum())} of {len(frames)} frames solved",
        f"{len(set(labels) & set(subject.model.labels))} markers, {1e3 * rms:.3g} mm rms from the model",
        "median of the stated standard deviations, in the worst direction:",
        *sigmas(take.joints),
        *written,
    ]


class _Writer:
    """Writes the requested files of a take."""

    def __init__(
        self, path: Path, subject: FittedSubject, take: SkeletonTake, frames: MarkerFrames, tracks: Tracks
    ) -> None:
        self.path, self.subject, self.take, self.frames, self.tracks = path, subject, take, frames, tracks

    def write(self, outputs: Outputs, rate: float, heading_deg: float, opensim: str) -> list[str]:
        """Write the files; return the lines to print. Raises InputError for data that a file cannot hold."""
        joints = self.take.joints
        angles = isb_angles(joints, heading_rad=float(np.deg2rad(heading_deg)))
        lines = []
        if outputs.mot:
            lines += self._mot(outputs.mot, opensim)
        if outputs.c3d:
            write_joints_c3d(outputs.c3d, joints, angles, rate, self.tracks)
            lines.append(f"markers, joint centres and angles in {outputs.c3d}")
        if outputs.bvh:
            write_bvh(motion_of(self.subject, self._all_frames(), rate), outputs.bvh)
            lines.append(f"motion in {outputs.bvh}, in centimetres")
        if outputs.out:
            write_joints_csv(joints, outputs.out)
            lines.append(f"joints with covariances in {outputs.out}")
        if outputs.angles:
            write_angles_csv(angles, outputs.angles)
            lines.append(f"joint angles in {outputs.angles}")
        if outputs.rrd:
            self._rrd(outputs.rrd)
            lines.append(f"markers and bones in {outputs.rrd}, for 'mosca view'")
        if outputs.plot:
            strikes = self._strikes()
            write_text(outputs.plot, svg_file(angles_picture(angles, strikes=strikes)))
            over = "time" if strikes is None else "the gait cycle"
            lines.append(f"joint angles over {over} in {outputs.plot}")
        return lines

    def _rrd(self, out: Path) -> None:
        """Write markers and bones for the Rerun viewer."""
        with whole_file(out) as temporary, RerunLog(temporary, Rig(())) as log:
            for k, (frame, time_ns) in enumerate(zip(self.frames.frame, self.frames.time_ns, strict=True)):
                seen = np.flatnonzero(self.frames.seen[k])
                log.log_step(int(frame), int(time_ns), points_xyz=self.frames.xyz[k, seen], track_ids=seen)
            show_person(log, self.take.joints)

    def _mot(self, out: Path, opensim: str) -> list[str]:
        """Write OpenSim's coordinates for the frames that have all coordinates that are known in any frame."""
        joints = self.take.joints
        angles = isb_angles(joints)
        known = np.isfinite(angles.angles)
        wanted = {name for name, _ in COORDINATES.values()}
        used = np.array([k for k, name in enumerate(angles.names) if name in wanted and known[:, k].any()], dtype=int)
        placed = np.zeros(len(joints), dtype=bool)
        if "pelvis" in joints.joints:
            k = joints.joints.index("pelvis")
            placed = np.isfinite(np.hstack([joints.centre[:, k], joints.rotation[:, k]])).all(axis=1)
        rows = np.flatnonzero(known[:, used].all(axis=1) & (placed | ~placed.any()))
        if not len(used) or not len(rows):
            raise InputError(
                f"{out}: no frame in which all coordinates are known; OpenSim takes no gaps: leave --mot out"
            )
        chosen = JointAngles(
            angles.frame[rows], angles.time_ns[rows], tuple(angles.names[k] for k in used),
            angles.angles[np.ix_(rows, used)], angles.sigma[np.ix_(rows, used)],
        )  # fmt: skip
        write_mot(chosen, out, model=opensim, pelvis=joints.select(rows) if placed.any() else None)
        left = len(joints) - len(rows)
        return [f"{len(used)} coordinates in {out}" + (f"; {left} frames with gaps are left out" if left else "")]

    def _all_frames(self) -> Array:
        """Return the poses (t, nq) from the first frame to the last, NaN where there is none."""
        q, frame = self.take.q, self.frames.frame
        span = int(frame[-1] - frame[0]) + 1
        if span * q.shape[1] > MOST_CELLS:
            raise InputError(f"{self.path}: frames {frame[0]} to {frame[-1]} are too many for a .bvh; give --frames")
        whole = np.full((span, q.shape[1]), np.nan)
        whole[frame - frame[0]] = q
        return whole

    def _strikes(self) -> dict[str, Array] | None:
        """Return heel strikes where both feet have two or more, else None (the person does not walk)."""
        joints, frames = self.take.joints, self.frames
        heels = {
            side: frames.xyz[:, k] for k, name in enumerate(frames.labels) for side in "lr" if name == _heel(side)
        }
        feet = [side for side in "lr" if side in heels or f"{side}_ankle" in joints.joints]
        if "pelvis" not in joints.joints or len(feet) < 2:
            return None
        strikes = heel_strikes(joints, heels)
        return strikes if min(map(len, strikes.values())) > 1 else None


def _heel(side: str) -> str:
    return f"{side.upper()}HEE"


def _model(path: Path, labels: tuple[str, ...], source: Path) -> tuple[SkeletonModel, list[str]]:
    """Return the model in ``path`` with the markers that ``labels`` name, and labels that are not in it."""
    text = read_text(path, "a skeleton model (MJCF)", most_bytes=MOST_BYTES)
    mj: Any = compiled(text, str(path))
    known = tuple(mj.site(k).name for k in range(mj.nsite))
    _check_known(labels, known, source, str(path), "rename the tracks (mosca edit), or give --model with your names")
    return model_from_mjcf(text, mj, labels, str(path)), _suggested(labels, known)


def _suggested(labels: tuple[str, ...], known: tuple[str, ...]) -> list[str]:
    """Return the unknown labels, each with the nearest known name that no label has, where there is one."""
    free = {name.upper(): name for name in known if name not in labels}
    found = []
    for label in labels:
        if label not in known:
            near = get_close_matches(label.upper(), free, 1)
            found.append(f"{label} ({free[near[0]]}?)" if near else label)
    return found


def _check_known(labels: tuple[str, ...], known: tuple[str, ...], source: Path, of: str, advice: str) -> None:
    """Raise InputError where fewer labels are known than a pose needs."""
    shared = set(labels) & set(known)
    if len(shared) < FEWEST_MARKERS:
        raise InputError(
            f"{source}: {len(shared)} of its labels are markers of {of}, {FEWEST_MARKERS} or more are wanted; its "
            f"labels are {', '.join(_suggested(labels, known)[:8])}, markers {', '.join(known[:8])}, ...; {advice}"
        )


def _check_single(tracks: Tracks, labels: tuple[str, ...], source: Path) -> None:
    """Raise InputError where a frame has two measured samples of one of ``labels``."""
    names, which = np.unique(tracks.label, return_inverse=True)
    short = [short_label(name) for name in names.tolist()]
    marker = np.array([labels.index(name) if name in labels else -1 for name in short])[which]
    rows = np.flatnonzero((marker >= 0) & (tracks.status == "measured"))
    order = rows[np.lexsort((marker[rows], tracks.frame[rows]))]
    same = (np.diff(tracks.frame[order]) == 0) & (np.diff(marker[order]) == 0)
    if same.any():
        a, b = order[np.flatnonzero(same)[0] :][:2]
        given = [str(tracks.label[k]) for k in (a, b)]
        people = sorted({name.rsplit(":", 1)[0] for name in given if ":" in name})
        advice = f"--person {people[0]} takes one person" if len(people) > 1 else "rename or delete one (mosca edit)"
        raise InputError(
            f"{source}: {given[0]} and {given[1]} stand at once in frame {tracks.frame[a]} (tracks {tracks.track[a]} "
            f"and {tracks.track[b]}); a marker has one track at a time: {advice}"
        )
