"""The person of a scenario: a skeleton fitted to labelled tracks, its pose in each frame, and files of these."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JointMotion
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from mosca.formats.bodies.bvh_writer import write_bvh
from mosca.formats.bodies.subject_file import write_subject
from mosca.formats.joints.angles_csv import write_angles_csv
from mosca.formats.joints.joints_csv import write_joints_csv
from mosca.skeleton.fit import FittedSubject, fit_subject
from mosca.skeleton.isb_angles import isb_angles
from mosca.skeleton.marker_frames import MarkerFrames, labels_of, marker_frames
from mosca.skeleton.model import HUMAN, read_skeleton_model
from mosca.skeleton.track import SkeletonTake, motion_of, track_subject
from reports.viewer import RerunLog
from scenarios.run.calibration_take import with_labels
from scenarios.score.people import true_motion, with_labels_swapped
from scenarios.spec.faults import LabelFault
from scenarios.spec.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Person:
    """A subject, its poses and joints in the take, their angles, the labelled tracks, and their frame rate [Hz]."""

    subject: FittedSubject
    take: SkeletonTake
    angles: JointAngles
    labelled: Tracks
    frame_rate_hz: float

    def scored(self, spec: Scenario) -> tuple[JointMotion, Tracks | None]:
        """Return the data compared with the truth: joints, and labels where they are not those of the truth."""
        given = spec.skeleton is None or spec.skeleton.labels == "truth"
        return self.take.joints, None if given else self.labelled

    def files(self) -> dict[str, Callable[[Path], object]]:
        """Return name of each file of a run folder -> function that writes it; no BVH file without a pose."""
        files: dict[str, Callable[[Path], object]] = {
            "joints.csv": lambda path: write_joints_csv(self.take.joints, path),
            "subject.npz": lambda path: write_subject(self.subject, path),
            "angles.csv": lambda path: write_angles_csv(self.angles, path),
        }
        if np.isfinite(self.take.q).any():
            moved = motion_of(self.subject, self.take.q, self.frame_rate_hz)
            files["skeleton.bvh"] = lambda path: write_bvh(moved, path)
        return files


def show_person(log: RerunLog | None, joints: JointMotion, truth: Truth | None = None) -> None:
    """Log a person's joints and bones, and the true ones where the truth has them; without a log do nothing."""
    if log is None:
        return
    motions = [(joints, False)]
    if truth is not None and truth.joints is not None:
        motions.append((true_motion(truth), True))
    for motion, true in motions:
        for k in range(len(motion)):
            one = motion.select(np.array([k]))
            log.log_skeleton(int(motion.frame[k]), int(motion.time_ns[k]), one, true)


@dataclass(frozen=True, eq=False)
class FitInputs:
    """The take to which a skeleton is fitted (None: the measurement itself), and the rig that measured both."""

    movement: MarkerFrames | None
    rig: Rig


def person_of(spec: Scenario, tracks: Tracks, truth: Truth, given: FitInputs) -> Person:
    """Return the person in ``tracks``, fitted to the take in ``given``. InputError if too few markers have labels."""
    labelled = with_labels(spec, tracks, truth)
    movement = given.movement
    if movement is None:
        movement = marker_frames(labelled, labels_of(labelled), given.rig)
    subject = fitted(movement)
    if isinstance(spec.fault, LabelFault):
        labelled = with_labels_swapped(labelled, spec.fault.pairs)
    return posed(subject, labelled, spec.capture.frame_rate_hz, given.rig)


def fitted(movement: MarkerFrames) -> FittedSubject:
    """Return the built-in model fitted to labelled markers; markers that are not in the model are left out."""
    model = read_skeleton_model(HUMAN, movement.labels)
    return fit_subject(model, movement.of(model.labels), "the take that the skeleton is fitted to")


def posed(subject: FittedSubject, labelled: Tracks, frame_rate_hz: float, rig: Rig) -> Person:
    """Return the subject in each frame of labelled tracks that ``rig`` measured."""
    take = track_subject(subject, marker_frames(labelled, subject.model.labels, rig))
    return Person(subject, take, isb_angles(take.joints), labelled, frame_rate_hz)
