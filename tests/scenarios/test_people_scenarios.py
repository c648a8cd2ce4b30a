"""[skeleton] of a scenario: wrong keys told of in one line; the person of a take, from labelled tracks to files."""

from dataclasses import replace

import numpy as np
import pytest
from track_tables import measured_tracks

from mosca.data.rig import Rig
from mosca.data.truth import Truth
from mosca.errors import InputError
from mosca.formats.joints.joints_csv import read_joints_csv
from mosca.labelling.automatic.label import AutomaticLabels
from mosca.skeleton.marker_frames import labels_of, marker_frames
from scenarios.build.scene import build_scene
from scenarios.run import calibration_take as module
from scenarios.run.calibration_take import calibration_take, take_of, with_labels
from scenarios.run.people import FitInputs, fitted, person_of, posed
from scenarios.score.people import (
    centre_errors,
    joint_scores,
    labelled_by_truth,
    rotation_errors,
    with_labels_swapped,
)
from scenarios.spec.catalog import LIBRARY
from scenarios.spec.scenario import load_scenario
from scenarios.types import RunOptions
from twin.truth_log import joints_at

WALK = LIBRARY / "people" / "walk_rigid.toml"
RATE_HZ = 20.0
RIG = Rig(())
"""No camera: none is known to shake."""


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["skeleton.fit_to=walk"], ["'skeleton.fit_to'", "'take' or 'range_of_motion'"]),
        (["skeleton.labels=found"], ["'skeleton.labels'", "'truth' or 'auto'"]),
        (["limits.label_f1=0.9"], ["limits.label_f1 needs labels that are found; set skeleton.labels = 'auto'"]),
        (["skeleton.calibration_s=0"], ["'skeleton.calibration_s'", "greater than 0"]),
        (["skeleton.fit_to=take", "skeleton.calibration_s=5"], ["calibration_s = 5 and fit_to = 'take'"]),
        (
            ["skeleton.fit_to=take", "fault.kind=swapped_labels", "fault.pairs=[['a', 'b'], ['b', 'c']]"],
            ["pairs name 'b' twice"],
        ),
        (["scene={kind='drone'}"], ["[skeleton] with scene.kind = 'drone'", "leave it out"]),
        (["scene.motion=walk.bvh"], ["fit_to = 'range_of_motion' with scene.motion = 'walk.bvh'", "fit_to = 'take'"]),
        (["continuous={}"], ["[skeleton] with [continuous]"]),
    ],
)
def test_wrong_keys_are_told_of_in_one_line(overrides, told):
    with pytest.raises(InputError) as refused:
        load_scenario(WALK, tuple(overrides))
    text = str(refused.value)
    assert "\n" not in text
    assert "walk_rigid.toml" in text
    for part in told:
        assert part in text


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("[limits]\njoint_center_rms = 0.002", "limits.joint_center_rms needs a skeleton; add [skeleton]"),
        (
            '[fault]\nkind = "swapped_labels"\npairs = [["a", "b"]]\n[limits]\nnees = 3',
            "needs the labels of a skeleton",
        ),
    ],
)
def test_what_needs_a_skeleton_says_so(tmp_path, line, told):
    path = tmp_path / "one.toml"
    path.write_text(f'title = "x"\n[working_space]\nsize_m = [3, 3, 3]\n[scene]\nkind = "actor"\n{line}\n')
    with pytest.raises(InputError, match=told.replace("[", r"\[")):
        load_scenario(path)


def test_frames_of_another_source_have_no_calibration_take():
    spec = load_scenario(WALK)
    options = RunOptions(source="recording:DIR")
    with pytest.raises(InputError, match=r"--source recording:DIR: .* add --set skeleton.fit_to=take") as refused:
        calibration_take(spec, WALK.parent, (), None, None, options)
    assert "\n" not in str(refused.value)


def test_the_take_that_is_fitted_to_is_of_the_same_person():
    spec = load_scenario(LIBRARY / "people" / "walk_moderate.toml", ("capture.duration_s=1",))
    scenes = [build_scene(one, WALK.parent) for one in (spec, take_of(spec))]
    assert scenes[0].marker_names == scenes[1].marker_names
    assert scenes[1].duration_s == 24.0
    # the skin answers to the same posture with the same slide
    skins = [scene.configuration_at.posture for scene in scenes]
    np.testing.assert_array_equal(*skins)


def taken(spec, seconds, *, rate_hz=RATE_HZ, noise_m=2e-4):
    """Return tracks without labels of the scenario's person, with noise alone, and the truth."""
    spec = spec.model_copy(update={"capture": spec.capture.model_copy(update={"duration_s": seconds})})
    scene = build_scene(spec, WALK.parent)
    time_s = np.arange(round(seconds * rate_hz)) / rate_hz
    sampler = scene.sampler()
    xyz = np.array([sampler.at(float(now)).marker_xyz for now in time_s])
    t, m = xyz.shape[:2]
    time_ns = np.rint(time_s * 1e9).astype(np.int64)
    nothing = np.zeros((t, m, 3, 2))
    truth = Truth(
        time_ns, tuple(scene.marker_names), xyz, np.ones((t, m, 3)), ("a", "b", "c"), nothing, nothing[..., 0],
        np.zeros((t, 3)), joints=joints_at(scene, time_s),
    )  # fmt: skip
    moved = xyz + np.random.default_rng(5).normal(0.0, noise_m, xyz.shape)
    frame, track = np.repeat(np.arange(t), m), np.tile(np.arange(m), t)
    tracks = measured_tracks(frame, track, moved.reshape(-1, 3), sigma_m=noise_m)
    return replace(tracks, time_ns=time_ns[frame]), truth


@pytest.fixture(scope="module")
def subject():
    """The walker on bones, fitted to 24 frames of its range of motion."""
    take = take_of(load_scenario(WALK))
    tracks, truth = taken(take, 24.0, rate_hz=1.0)
    labelled = labelled_by_truth(tracks, truth, 2.5)
    return fitted(marker_frames(labelled, labels_of(labelled)))


def scores_of(person, truth):
    errors = centre_errors(person.take.joints, truth), rotation_errors(person.take.joints, truth)
    return joint_scores(*errors)


def test_joints_of_a_walker_are_found_scored_and_written(tmp_path, subject):
    spec = load_scenario(WALK)
    tracks, truth = taken(spec, 0.5)
    person = posed(subject, labelled_by_truth(tracks, truth, 2.5), RATE_HZ, RIG)
    scores = scores_of(person, truth)
    assert scores["joint_completeness"].value == 1.0
    assert scores["joint_center_rms"].value < spec.limits["joint_center_rms"]
    assert scores["joint_angle_rms"].value < np.deg2rad(2.0)  # of 24 frames of the movement
    written = person.files()
    assert set(written) == {"joints.csv", "angles.csv", "subject.npz", "skeleton.bvh"}
    for name, write in written.items():
        write(tmp_path / name)
    again = read_joints_csv(tmp_path / "joints.csv")
    np.testing.assert_array_equal(again.centre, person.take.joints.centre)


def test_swapped_legs_are_crosswise(subject):
    control = load_scenario(LIBRARY / "controls" / "swapped_legs.toml")
    tracks, truth = taken(control, 1.0, rate_hz=5.0)
    labelled = with_labels_swapped(labelled_by_truth(tracks, truth, 2.5), control.fault.pairs)
    person = posed(subject, labelled, 5.0, RIG)
    low, high = control.breaks["joint_center_rms"]
    assert low < scores_of(person, truth)["joint_center_rms"].value < high
    # the left knee is found where the right one is
    joints, true = person.take.joints, truth.joints
    away = joints.centre[:, joints.joints.index("l_knee")] - true.centre[:, true.names.index("r_knee")]
    assert np.linalg.norm(away, axis=1).max() < 0.1


def test_where_no_marker_has_a_label_no_pose_is_made_up(subject):
    tracks, truth = taken(load_scenario(WALK), 0.2)
    far = replace(tracks, xyz=tracks.xyz + 100.0)
    person = posed(subject, labelled_by_truth(far, truth, 2.5), RATE_HZ, RIG)
    assert set(person.files()) == {"joints.csv", "angles.csv", "subject.npz"}
    assert {name: score.value for name, score in scores_of(person, truth).items()} == {"joint_completeness": 0.0}


def test_without_a_calibration_take_the_take_itself_is_fitted_to():
    spec = load_scenario(WALK, ("skeleton.fit_to=take",))
    tracks, truth = taken(spec, 1.5, rate_hz=4.0)
    person = person_of(spec, tracks, truth, FitInputs(None, RIG))
    assert person.subject.frames == 6
    assert scores_of(person, truth)["joint_completeness"].value > 0.5  # a hinge that hardly bends has no axis


def test_too_few_markers_are_told_of():
    spec = load_scenario(WALK)
    tracks, truth = taken(spec, 0.2)
    with pytest.raises(InputError, match="labels are markers of the model, six or more are wanted"):
        person_of(spec, tracks.select(tracks.track < 5), truth, FitInputs(None, RIG))


def test_labels_are_found_where_that_is_asked_for(monkeypatch):
    spec = load_scenario(WALK, ("skeleton.labels=auto",))
    tracks, truth = taken(spec, 0.2)
    found = replace(tracks, label=np.full(len(tracks), "LASI"))
    given = []

    def automatic(tracks, template):
        given.append((tracks, set(template.names)))
        return AutomaticLabels(found, np.ones(len(tracks)))

    monkeypatch.setattr(module, "label_automatically", automatic)
    assert with_labels(load_scenario(WALK), tracks, truth) is not found
    assert not given
    # in both takes; with a template that has the actor's markers
    assert with_labels(spec, tracks, truth) is with_labels(take_of(spec), tracks, truth) is found
    assert all(one is tracks and set(truth.names) <= names for one, names in given)
