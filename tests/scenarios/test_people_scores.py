"""Joints against the truth: known offsets give known figures; labels and keys of [skeleton]."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from track_tables import measured_tracks

from mosca.data.joint_motion import JointMotion
from mosca.data.truth import JointTruth, Truth
from mosca.errors import InputError
from reports.units import shown
from scenarios.score.people import (
    centre_errors,
    joint_scores,
    joint_table,
    label_scores,
    labelled_by_truth,
    rotation_errors,
    true_motion,
    with_labels_swapped,
)

JOINTS = ("pelvis", "neck", "l_knee", "r_knee")
FRAMES = 80
SIGMA_M, SIGMA_RAD = 1e-3, 2e-3


def truth_of(markers=((0, 0, 0), (1, 0, 0))):
    rng = np.random.default_rng(3)
    centre = rng.normal(size=(FRAMES, len(JOINTS), 3))
    centre[:, 1] = np.nan  # the neck has no single centre
    rotation = Rotation.random(FRAMES * len(JOINTS), random_state=4).as_quat(scalar_first=True)
    rotation = rotation.reshape(FRAMES, len(JOINTS), 4)
    rotation[:, 3] = np.nan  # an axis of the right shank is missing
    m = len(markers)
    return Truth(
        np.arange(FRAMES) * 10_000_000,
        tuple(f"m{k}" for k in range(m)),
        np.tile(np.array(markers, float), (FRAMES, 1, 1)),
        np.ones((FRAMES, m, 3)),
        ("a", "b", "c"),
        np.zeros((FRAMES, m, 3, 2)),
        np.ones((FRAMES, m, 3)),
        np.zeros((FRAMES, 3)),
        joints=JointTruth(JOINTS, centre, rotation),
    )


def measured(truth, *, moved_m=(0.0, 0.0, 0.0), turned_rad=(0.0, 0.0, 0.0)):
    """The truth, each centre moved and each rotation turned about the distal axes; with the covariances above."""
    motion = true_motion(truth)
    turn = Rotation.from_rotvec(turned_rad)
    quaternion = motion.rotation.reshape(-1, 4)
    known = np.isfinite(quaternion).all(axis=1)
    turned = np.full_like(quaternion, np.nan)
    # R_true = R exp([r])
    own = Rotation.from_quat(quaternion[known], scalar_first=True) * turn.inv()
    turned[known] = -own.as_quat(scalar_first=True)  # the other sign is the same rotation
    each = (FRAMES, len(JOINTS), 1, 1)
    return replace(
        motion,
        centre=motion.centre + np.array(moved_m),
        rotation=turned.reshape(motion.rotation.shape),
        centre_covariance=np.tile(SIGMA_M**2 * np.eye(3), each),
        rotation_covariance=np.tile(SIGMA_RAD**2 * np.eye(3), each),
    )


def scores_of(motion, truth, calibration=None):
    return joint_scores(centre_errors(motion, truth, calibration), rotation_errors(motion, truth))


def values(scores):
    return {name: score.value for name, score in scores.items()}


def test_what_is_right_has_no_error():
    truth = truth_of()
    found = values(scores_of(measured(truth), truth))
    assert found == pytest.approx(
        {
            "joint_completeness": 1.0,
            "joint_center_rms": 0.0,
            "joint_center_nees": 0.0,
            "joint_center_coverage95": 1.0,
            "joint_angle_rms": 0.0,
            "joint_angle_nees": 0.0,
            "joint_angle_coverage95": 1.0,
        },
        abs=1e-12,
    )


def test_known_offsets_give_known_figures():
    truth = truth_of()
    # 3D distance 3 mm; components 6, 0 and 3 mrad: rms sqrt(45 / 3)
    motion = measured(truth, moved_m=(2e-3, -1e-3, 2e-3), turned_rad=(6e-3, 0.0, -3e-3))
    scores = scores_of(motion, truth)
    assert scores["joint_center_rms"].value == pytest.approx(3e-3)
    assert scores["joint_center_rms"].ci95 == pytest.approx((3e-3, 3e-3))
    assert scores["joint_center_rms"].n == 2 * FRAMES  # of both knees: the pelvis is no joint, the neck has no centre
    assert scores["joint_angle_rms"].value == pytest.approx(np.sqrt(15) * 1e-3)
    assert scores["joint_angle_rms"].n == 3 * FRAMES  # the right knee's is not known
    # 9 mm^2 / (1 mm)^2 and 45 mrad^2 / (2 mrad)^2, both beyond chi squared's 7.81
    assert scores["joint_center_nees"].value == pytest.approx(9.0)
    assert scores["joint_angle_nees"].value == pytest.approx(11.25)
    assert scores["joint_center_coverage95"].value == scores["joint_angle_coverage95"].value == 0.0


def test_rotations_are_compared_in_the_distal_axes():
    truth = truth_of()
    row = joint_table(
        centre_errors(motion := measured(truth, turned_rad=(1e-2, 2e-2, 3e-2)), truth), rotation_errors(motion, truth)
    )["pelvis"]
    assert row["angle_rms_rad"] == pytest.approx([1e-2, 2e-2, 3e-2])
    assert "center_rms_m" not in row


def test_the_calibrations_share_is_added_to_the_centres_covariance():
    truth = truth_of()
    motion = measured(truth, moved_m=(2e-3, 0.0, 0.0))
    with_share = scores_of(motion, truth, lambda xyz: np.tile(3e-6 * np.eye(3), (len(xyz), 1, 1)))
    assert with_share["joint_center_nees"].value == pytest.approx(1.0)
    assert scores_of(motion, truth)["joint_center_nees"].value == pytest.approx(4.0)


def test_what_the_estimate_does_not_know_is_a_miss():
    truth = truth_of()
    motion = measured(truth)
    centre = motion.centre.copy()
    centre[:20, JOINTS.index("l_knee")] = np.nan
    motion = replace(motion, centre=centre).select(np.arange(0, FRAMES, 2))
    scores = scores_of(motion, truth)
    # of 2 centres and 3 rotations in each frame, half are there, less 10 of the left knee
    assert scores["joint_completeness"].value == pytest.approx((5 * 40 - 10) / (5 * 80))
    assert scores["joint_center_rms"].n == 2 * 40 - 10
    names = tuple(name for name in JOINTS if name != "l_knee")
    keep = [JOINTS.index(name) for name in names]
    fewer = JointMotion(
        motion.frame, motion.time_ns, names, *(getattr(motion, f)[:, keep] for f in JointMotion.__dataclass_fields__
        if f not in ("frame", "time_ns", "joints"))
    )  # fmt: skip
    assert scores_of(fewer, truth)["joint_completeness"].value == pytest.approx(3 * 40 / 400)


def test_an_instant_that_is_not_the_truths_is_a_miss():
    truth = truth_of()
    late = measured(truth)
    late = replace(late, time_ns=late.time_ns + 10_000_000_000)
    assert values(scores_of(late, truth)) == {"joint_completeness": 0.0}


def test_a_covariance_of_nothing_is_never_right():
    truth = truth_of()
    motion = measured(truth, moved_m=(1e-3, 0.0, 0.0))
    flat = replace(motion, centre_covariance=np.zeros_like(motion.centre_covariance))
    scores = scores_of(flat, truth)
    assert scores["joint_center_nees"].value == np.inf
    assert scores["joint_center_coverage95"].value == 0.0


def test_right_covariances_have_a_nees_of_three():
    truth, rng = truth_of(), np.random.default_rng(1)
    motion = measured(truth)
    moved = replace(motion, centre=motion.centre + rng.normal(0.0, SIGMA_M, motion.centre.shape))
    scores = scores_of(moved, truth)
    # 160 values of chi squared with 3 degrees of freedom: 3 +- 4 sqrt(6 / 160); 95 % +- 4 sqrt(0.0475 / 160)
    assert scores["joint_center_nees"].value == pytest.approx(3.0, abs=0.8)
    assert scores["joint_center_coverage95"].value == pytest.approx(0.95, abs=0.07)
    low, high = scores["joint_center_nees"].ci95
    assert low < scores["joint_center_nees"].value < high


def test_labels_are_those_of_the_scorings_pairs():
    truth = truth_of()
    rows = [(f, 5 + k, k + 0.001, 0.0, 0.0) for f in range(3) for k in (1, 0)] + [(3, 9, 0.5, 0.0, 0.0)]
    r = np.array(rows)
    tracks = measured_tracks(r[:, 0], r[:, 1], r[:, 2:])
    labelled = labelled_by_truth(tracks, truth, 2.0)
    wanted = [{5: "m0", 6: "m1", 9: ""}[track] for track in labelled.track.tolist()]
    assert labelled.label.tolist() == wanted
    swapped = with_labels_swapped(labelled, [("m0", "m1")])
    assert swapped.label.tolist() == [{"m0": "m1", "m1": "m0", "": ""}[name] for name in wanted]
    with pytest.raises(InputError, match=r"fault\.pairs: 'm7' given; the tracks have m0, m1"):
        with_labels_swapped(labelled, [("m0", "m7")])


def test_a_sample_that_is_not_measured_has_no_label():
    tracks = measured_tracks(np.zeros(2), np.arange(2), np.array([[0.0, 0, 0], [1.0, 0, 0]]))
    tracks = replace(tracks, status=np.array(["filled", "measured"]))
    assert labelled_by_truth(tracks, truth_of(), 2.0).label.tolist() == ["", "m1"]


def test_angles_of_joints_are_shown_in_degrees():
    (value,), unit = shown((np.deg2rad(0.5),), "rad", "joint_angle_rms")
    assert (value, unit) == (pytest.approx(0.5), "deg")
    assert shown((0.01,), "rad", "body_angle_rms") == ((10.0,), "mrad")


def test_f1_and_changes_of_labels():
    rows = np.array([(f, k, k + 0.001, 0.0, 0.0) for f in range(4) for k in (0, 1)])
    tracks = measured_tracks(rows[:, 0], rows[:, 1], rows[:, 2:])
    truth = truth_of()
    right = np.array(["m0", "m1"] * 4)
    found = label_scores(replace(tracks, label=right), truth, 2.0)
    assert values(found) == {"label_f1": 1.0, "label_switches": 0.0}
    # one without a label, one wrong for one frame: 6 right, 7 with a label, 8 that are markers; there and back
    names = np.array(["m0", "m1", "", "m1", "m0", "m9", "m0", "m1"])
    found = label_scores(replace(tracks, label=names), truth, 2.0)
    assert values(found) == {"label_f1": pytest.approx(12 / 15), "label_switches": 2.0}
    # a ghost with a label counts against it
    ghost = measured_tracks(np.zeros(1), np.full(1, 7), np.full((1, 3), 0.5), label=["m3"])
    both = type(tracks)(*(np.concatenate([getattr(one, f) for one in (replace(tracks, label=right), ghost)])
        for f in type(tracks).__dataclass_fields__))  # fmt: skip
    assert label_scores(both, truth, 2.0)["label_f1"].value == pytest.approx(16 / 17)
