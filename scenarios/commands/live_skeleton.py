"""A person followed in a live run: labels for its tracks, joints in a file, bones in the viewer."""

import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.detections import Detections
from mosca.data.rig import Rig
from mosca.data.tracks import Samples
from mosca.errors import InputError
from mosca.formats.bodies.subject_file import read_subject
from mosca.formats.joints.joints_csv import JointsLog
from mosca.pipeline import Step
from mosca.skeleton.live import LivePose, LiveSkeleton
from mosca.skeleton.model import Kinematics
from mosca.skeleton.track import SkeletonTracker
from reports.viewer import RerunLog, check_rrd
from reports.viewer_process import SHOWN_HZ, ViewerClosedError, log_in_viewer
from reports.viewer_program import check_window, viewer_program
from scenarios.commands.live_sources import LiveOptions
from scenarios.commands.skeleton_words import check_bodies


class LivePerson:
    """A subject in a live run.

    ``labels``: those of its markers; ``example``: its joints in a pose of the take to which it was fitted, None where
    the model has too few markers for one.
    """

    def __init__(self, path: Path, joints: Path | None, stack: ExitStack) -> None:
        subject = read_subject(path)
        check_bodies(subject, path)
        self.labels = subject.model.labels
        self._log = None if joints is None else JointsLog(joints)
        if self._log is not None:
            stack.callback(self._log.close)
        kinematics = Kinematics(subject.model, subject.parameters)
        kinematics.pose(subject.q)
        tracker = SkeletonTracker(subject)
        # compiles functions whose compilation would else count as latency
        solution = tracker.step(kinematics.markers(), np.zeros((len(self.labels), 3, 3)))
        self.example = None if solution is None else tracker.joints_at(solution, 0, 0)
        self._live = stack.enter_context(LiveSkeleton(subject, background=True))
        self._frame = -1
        self.posed = self.frames = self._named = 0
        self._first_ns = self._found_ns = None  # type: int | None

    def measured_by(self, rig: Rig) -> None:
        """Set the cameras, whose shake is separated from the markers' own errors."""
        self._live.rig = rig

    def step(self, samples: Samples) -> tuple[list[LivePose], Mapping[tuple[int, int], str]]:
        """Follow the frames of ``samples`` that are later than earlier ones; return poses, and the labels."""
        poses = []
        label_of: dict[tuple[int, int], str] = {}
        for frame in np.unique(samples.frame[samples.frame > self._frame]).tolist():
            time_ns = int(samples.time_ns[samples.frame == frame][0])
            pose = self._live.step(frame, time_ns, samples)
            self._frame = frame
            self.frames += 1
            self._first_ns = time_ns if self._first_ns is None else self._first_ns
            named = np.flatnonzero(pose.label != "")
            self._named += len(named)
            label_of |= {(frame, int(pose.track[k])): str(pose.label[k]) for k in named}
            if pose.joints is not None:
                self.posed += 1
                self._found_ns = time_ns if self._found_ns is None else self._found_ns
                if self._log is not None:
                    self._log.write(pose.joints)
            poses.append(pose)
        return poses, label_of

    def finish(self) -> list[str]:
        """Write the remaining poses; return the lines to print."""
        if self._found_ns is None or self._first_ns is None:
            lines = ["skeleton: the person was not found; is the whole body seen, with the markers of the fit?"]
        else:
            lines = [
                f"skeleton: first after {1e-9 * (self._found_ns - self._first_ns):.1f} s, in {self.posed} of "
                f"{self.frames} frames, {self._named / max(self.posed, 1):.1f} of {len(self.labels)} markers; "
                f"lost {self._live.losses} times"
            ]
        if self._log is not None:
            frames = self._log.finish()
            lines.append(f"joints of {frames} frames in {self._log.path}" if frames else "no joints to write")
        return lines


class LiveShow:
    """Points and bones of a live run in Rerun: every frame in a file, some frames a second in the viewer."""

    def __init__(self, options: LiveOptions, rig: Rig, stack: ExitStack) -> None:
        self._file = None if options.rrd is None else stack.enter_context(RerunLog(options.rrd, rig))
        self._viewer = stack.enter_context(log_in_viewer(rig)) if options.view else None
        self._due = 0.0
        self._closed: str | None = None
        self._images_each_ns = 1e9 / options.images if options.images else np.inf
        self._images_due_ns = -np.inf

    @property
    def logs(self) -> tuple[RerunLog, ...]:
        """The logs of the file and the viewer, those that exist."""
        return tuple(log for log in (self._file, self._viewer) if log is not None)

    def show(
        self, frame: int, time_ns: int, samples: Samples, poses: list[LivePose], step: Step | None = None
    ) -> None:
        """Log the samples of one frame and the poses; if images are due, also images and detections of ``step``."""
        logs = [] if self._file is None else [self._file]
        now = time.monotonic()
        if self._viewer is not None and self._closed is None and now >= self._due:
            self._due = now + 1 / SHOWN_HZ
            logs.append(self._viewer)
        tracked = samples.select(samples.frame == frame)
        images, detections = self._images_of(step, time_ns) if logs else (None, None)
        sigma_m = np.sqrt(np.trace(tracked.covariance, axis1=1, axis2=2))
        for log in logs:
            try:
                log.log_step(frame, time_ns, images, detections, tracked.xyz, tracked.track, sigma_m)
            except ViewerClosedError as why:
                self._closed = f"view: ended early at frame set {frame} ({why})"
                continue
            for pose in poses:
                log.log_skeleton(pose.frame, pose.time_ns, pose.joints)

    def finish(self) -> list[str]:
        """Return a line where the viewer ended before the run did."""
        return [] if self._closed is None else [self._closed]

    def _images_of(
        self, step: Step | None, time_ns: int
    ) -> tuple[Mapping[str, Array] | None, Mapping[str, Detections] | None]:
        """Return the images of a step and the detections in them, where images are due by the frames' clock."""
        if step is None or time_ns < self._images_due_ns or not np.isfinite(self._images_each_ns):
            return None, None
        # counted from the due instant: else a rate that is no divisor of the frame rate would fall behind
        late_ns = time_ns - self._images_due_ns
        self._images_due_ns += self._images_each_ns
        if not late_ns < self._images_each_ns:
            self._images_due_ns = time_ns + self._images_each_ns
        images = {name: frame.image for name, frame in step.frame_set.frames.items() if frame.image is not None}
        return images, step.detections


def check_show(options: LiveOptions) -> None:
    """Raise InputError for options of a person if none is given, and for a recording that cannot be written."""
    if options.joints is not None and options.skeleton is None:
        raise InputError(f"--joints {options.joints}: whose joints? give --skeleton with what 'skeleton fit' wrote")
    if options.images and options.rrd is None and not options.view:
        raise InputError("--images: where are they to be shown? add --rrd FILE.rrd or --view")
    if options.view:
        viewer_program("--view")
        check_window("--view", "give --rrd FILE.rrd, which 'mosca view FILE.rrd --web' shows, or leave it out")
    check_rrd(options.rrd)
