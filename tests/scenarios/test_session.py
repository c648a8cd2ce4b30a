"""The calibration session of a scenario: its target file, its faults, and the findings expected of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosca.camera.projection import project
from mosca.data.boards import Board
from mosca.data.frames import CameraInfo, Frame
from mosca.data.targets import TestField as Field
from mosca.data.wands import Wand
from mosca.errors import CalibrationError, InputError
from scenarios.build.cameras import true_rig, virtual_cameras
from scenarios.run import scenario as runner
from scenarios.run.folder import write_run
from scenarios.run.scenario import run_scenario
from scenarios.session.estimated import calibrate_in_session
from scenarios.session.faults import swapped, turned
from scenarios.session.scenes import axes_session, bar_session, target_session
from scenarios.spec.scenario import Scenario, load_scenario
from twin.scenes.target_motion import put_from_stand_to_stand

SMALL = """
title = "small"
model_gap = "none"
{top}
[working_space]
center_m = [0.2, 0.0, 0.5]
size_m = [1.0, 1.0, 1.0]
[capture]
duration_s = 0.05
[scene]
kind = "cloud"
markers = 5
marker_diameter_m = 0.03
[cameras]
count = 3
azimuth_deg = [0.0, 100.0, 220.0]
radius_m = 2.0
height_m = [1.0, 1.4, 0.9]
c_mm = 5.0
size_px = [480, 360]
[calibration]
{calibration}
"""
FIELD = "markers = 60\nstands = 3\nframes = 2\nsize_m = [1.1, 1.1, 1.1]\nshift = 0.3"
WRONG_UNITS = 'fault = { kind = "wrong_units" }'
CAUGHT = 'expect = "caught"\ncaught_as = "{}"'


def spec(tmp_path: Path, calibration: str, top: str = "", limits: str = "position_rms = 1.0") -> Scenario:
    path = tmp_path / "small.toml"
    tail = f"[limits]\n{limits}\n" if limits else ""
    path.write_text(SMALL.format(top=top, calibration=calibration) + tail)
    return load_scenario(path)


# the target's file


def test_a_fields_file_has_its_places_as_well_as_they_are_known(tmp_path):
    given_spec = spec(tmp_path, "markers = 150\nknown_to = 0.001\nsize_m = [1.0, 1.0, 1.0]")
    session = target_session(given_spec, given_spec.calibration)
    # the marks of the twin's field in its first pose, which is the world's
    true = session.scene.sampler().at(0.0).marker_xyz
    off = session.target.positions - true
    assert session.target.sigma_m == pytest.approx(0.001)
    # 450 normal numbers of standard deviation 1 mm: their own spreads by a thirtieth
    assert np.sqrt(np.mean(off**2)) == pytest.approx(0.001, rel=0.15)
    # ten stands of two exposures, and eight more of the world
    assert session.pulses == 28


def test_faults_of_a_fields_file(tmp_path):
    def field(fault):
        one = spec(tmp_path, f"{FIELD}\n{fault}")
        return target_session(one, one.calibration).target

    right = field("")
    small = field('fault = { kind = "wrong_size", factor = 1.25 }')
    units = field('fault = { kind = "wrong_units" }')
    assert isinstance(right, Field)
    # true lengths are 1.25 times those in the file, the dots' too
    np.testing.assert_allclose(1.25 * small.positions, right.positions)
    assert 1.25 * small.targets[0].target.dot_radius_m == pytest.approx(right.targets[0].target.dot_radius_m)
    # millimetres for metres: the positions only
    np.testing.assert_allclose(units.positions, 1000 * right.positions)
    assert units.targets[0].target == right.targets[0].target


@pytest.mark.parametrize(
    ("fault", "factor"),
    [('{ kind = "wrong_size", factor = 1.25 }', 0.8), ('{ kind = "wrong_units", factor = 100.0 }', 100.0)],
)
def test_faults_of_boards_and_wands_files(tmp_path, fault, factor):
    for kind in ("board", "wand"):
        right, wrong = (
            target_session(one, one.calibration)
            for one in (
                spec(tmp_path, f'target = "{kind}"\nframes = 30\n{more}') for more in ("", f"fault = {fault}")
            )
        )
        # the thing itself is the same, only its file is not
        at = [session.scene.sampler().at(0.3).marker_xyz for session in (right, wrong)]
        np.testing.assert_array_equal(*at)
        if kind == "board":
            assert isinstance(wrong.target, Board)
            assert wrong.target.square_m == pytest.approx(factor * right.target.square_m)
        else:
            assert isinstance(wrong.target, Wand)
            np.testing.assert_allclose(wrong.target.along_m, factor * np.array(right.target.along_m))


def test_the_l_frame_stands_where_its_file_says_and_the_bar_is_as_long(tmp_path):
    one = spec(tmp_path, 'target = "wand"\nframes = 30')
    axes = axes_session(one)
    np.testing.assert_array_equal(axes.scene.sampler().at(1.0).marker_xyz, axes.target.positions)
    # at the bottom of the working space, its stems above its floor
    assert 0 < axes.target.positions[:, 2].min() < 0.1
    bar = bar_session(one)
    ends = bar.scene.sampler().at(0.7).marker_xyz
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(bar.target.length_m, rel=1e-9)


@given(
    stands=st.integers(1, 12),
    frames=st.integers(1, 60),
    rate_hz=st.floats(1.0, 500.0),
    share=st.floats(0.001, 0.9),
    seed=st.integers(0, 99),
    more=st.integers(0, 60),
)
def test_no_exposure_sees_the_target_go_to_its_next_stand(stands, frames, rate_hz, share, seed, more):
    exposure_s = share / rate_hz
    lead_s = (1 / rate_hz - exposure_s) / 2
    path = put_from_stand_to_stand(
        np.zeros(3),
        stands,
        frames / rate_hz,
        lead_s=lead_s,
        shift_m=np.ones(3),
        tilt_rad=0.3,
        rng=np.random.default_rng(seed),
        first_s=more / rate_hz,
    )
    np.testing.assert_array_equal(path(0.0), [0, 0, 0, 1, 0, 0, 0])  # the first pose is the world's
    np.testing.assert_allclose(np.linalg.norm(path.stands[:, 3:], axis=1), 1.0)
    assert (np.abs(path.stands[:, :3]) <= 1.0).all()
    for stand in range(stands):
        begin = more + stand * frames if stand else 0
        for exposure in (begin, more + (stand + 1) * frames - 1):
            start = exposure / rate_hz
            # the trigger's jitter, too: most of the lead to both sides
            for time in (start - 0.9 * lead_s, start, start + exposure_s, start + exposure_s + 0.9 * lead_s):
                np.testing.assert_array_equal(path(time), path.stands[stand])


# what goes wrong


def test_a_turned_camera_sees_all_moved_by_so_many_pixels(tmp_path):
    one = spec(tmp_path, FIELD)
    before = virtual_cameras(one, true_rig(one, tmp_path))
    after = turned(before, "cam2", 5.0)
    assert [v.camera for v in after if v.camera.name != "cam2"] == [
        v.camera for v in before if v.camera.name != "cam2"
    ]
    camera, moved = (next(v.camera for v in every if v.camera.name == "cam2") for every in (before, after))
    pose = camera.world_from_camera
    ahead = pose.translation + 2 * pose.rotation[:, 2]
    off = project(moved, ahead[None]) - project(camera, ahead[None])
    assert np.linalg.norm(off) == pytest.approx(5.0, abs=0.05)
    with pytest.raises(InputError, match="'left' given; the rig has cam1, cam2, cam3"):
        turned(before, "left", 5.0)


class Source:
    """Two frames of three cameras."""

    cameras = tuple(CameraInfo(name, 8, 6, 8, 10.0) for name in ("a", "b", "c"))
    closed = False

    def __iter__(self):
        for k, info in enumerate(self.cameras):
            yield Frame(info.name, 0, 0, 1000, np.full((6, 8), k, np.uint8))

    def close(self):
        self.closed = True

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()


def test_swapped_cameras_have_each_others_frames():
    inner = Source()
    with swapped(inner, ("a", "c")) as source:
        assert sorted(info.name for info in source.cameras) == ["a", "b", "c"]
        assert {frame.camera: int(frame.image[0, 0]) for frame in source} == {"a": 2, "b": 1, "c": 0}
    assert inner.closed
    with pytest.raises(InputError, match="'x' given; the rig has a, b, c"):
        swapped(Source(), ("a", "x"))


# findings


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Return calibrations from small sessions: without fault, and with positions in the file in millimetres."""
    folder = tmp_path_factory.mktemp("sessions")

    def made(fault):
        one = spec(folder, f"{FIELD}\n{fault}")
        rig = true_rig(one, folder)
        return calibrate_in_session(one, virtual_cameras(one, rig), rig, 1)

    return {"": made(""), WRONG_UNITS: made(WRONG_UNITS)}


def test_a_good_session_gives_the_true_rig(sessions):
    found = sessions[""]
    assert not found.calibration.refused
    scores = found.scores()
    assert scores["calibration_rays_rms"].value == np.sqrt(np.mean(found.ray_px**2)) < 0.3
    assert scores["calibration_volume_rms"].value == np.sqrt(np.mean(found.volume_m**2)) < 3e-4
    assert 0 < scores["calibration_sigma_x"].value < 1e-3


@pytest.fixture
def with_sessions(sessions, monkeypatch):
    """Let scenarios find their session calibrated already."""

    def known(given_spec, *rest):
        return sessions["" if given_spec.calibration.fault is None else WRONG_UNITS]

    monkeypatch.setattr(runner, "calibrate_in_session", known)
    monkeypatch.setattr(runner, "kept", lambda inputs, made: made())


def test_a_fault_that_is_told_of_is_caught(with_sessions, tmp_path):
    one = spec(tmp_path, f"{FIELD}\n{WRONG_UNITS}", CAUGHT.format("mixed-units"), limits="")
    result = run_scenario(one, "small", tmp_path)
    assert result.record.passed
    assert result.record.verdict.startswith("caught as it must be: mixed-units: ")
    assert len(result.tracks) == 0
    write_run(result, tmp_path / "out")
    assert "mixed-units" in (tmp_path / "out/calibration.html").read_text()
    assert result.calibration.calibration.refused
    assert list(tmp_path.rglob("rig.toml")) == []


def test_a_fault_that_is_told_of_by_another_name_is_not_caught(with_sessions, tmp_path):
    one = spec(tmp_path, f"{FIELD}\n{WRONG_UNITS}", CAUGHT.format("swapped-cameras"), limits="")
    record = run_scenario(one, "small", tmp_path).record
    assert not record.passed
    assert "not caught: 'swapped-cameras'" in record.verdict
    assert "mixed-units" in record.verdict


def test_a_control_without_a_fault_is_not_caught(with_sessions, tmp_path):
    one = spec(tmp_path, FIELD, CAUGHT.format("mixed-units"), limits="")
    record = run_scenario(one, "small", tmp_path).record
    assert not record.passed
    assert "told of was nothing" in record.verdict


def test_a_scenario_does_not_measure_with_a_refused_rig(with_sessions, tmp_path):
    with pytest.raises(CalibrationError, match="small: mixed-units: "):
        run_scenario(spec(tmp_path, f"{FIELD}\n{WRONG_UNITS}"), "small", tmp_path)


def test_a_session_that_does_not_do_at_all_is_caught_too(tmp_path):
    few = "markers = 6\nstands = 1\nframes = 1"
    result = run_scenario(spec(tmp_path, few, CAUGHT.format("few-views"), limits=""), "small", tmp_path)
    assert result.record.passed, result.record.verdict
    assert result.calibration is None
    write_run(result, tmp_path / "out")
    assert not (tmp_path / "out/rig.toml").exists()
    with pytest.raises(CalibrationError, match="few-views: "):
        run_scenario(spec(tmp_path, few), "small", tmp_path)


def test_the_pipeline_measures_with_the_estimated_rig(with_sessions, sessions, tmp_path):
    result = run_scenario(spec(tmp_path, FIELD), "small", tmp_path)
    assert result.record.passed, result.record.verdict
    assert result.evidence.rig is sessions[""].calibration.rig
    assert {"calibration_rays_rms", "position_rms"} <= {metric.name for metric in result.record.metrics}
    write_run(result, tmp_path / "out")
    assert {"rig.toml", "calibration.html"} <= {path.name for path in (tmp_path / "out").iterdir()}


# what a scenario may contain


@pytest.mark.parametrize(
    ("calibration", "says"),
    [
        ('target = "wand"\nstands = 3', "'stands' belongs to a field; target = 'wand' has none"),
        ('target = "board"', "frames = 2 given; a board is carried about"),
        ('target = "board"\nmarkers = 9', "'markers' belongs to a field"),
        ("relief = 0.1", "'relief' belongs to layout = 'plate'; 'tower' has its own"),
        ('target = "wand"\nframes = 30\nexterior_only = true', "a wand finds lenses, too"),
        ("markers = 508", "507"),
        ("tilt_deg = 70", "60"),
        ('target = "cube"', "'field', 'board'"),
        ('fault = { kind = "broken" }', "wrong_size"),
        ('fault = { kind = "wrong_size" }', "factor"),
        ("marker = 9", "marker"),
    ],
)
def test_wrong_words_are_told_in_one_line(tmp_path, calibration, says):
    with pytest.raises(InputError) as error:
        spec(tmp_path, calibration)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_the_true_rig_takes_the_tables_other_keys_and_catches_nothing(tmp_path):
    true = 'target = "none"\nmarkers = 9\nstands = 3'
    assert spec(tmp_path, true).session is None
    assert spec(tmp_path, FIELD).session is not None
    # without a session nothing could be found wrong with one: such a run must not pass
    with pytest.raises(InputError, match="needs a \\[calibration\\] in which something is wrong"):
        spec(tmp_path, true, CAUGHT.format("mixed-units"), limits="")


@pytest.mark.parametrize(
    ("top", "says"),
    [
        ('expect = "caught"', "belong together"),
        ('caught_as = "few-views"', "belong together"),
        (CAUGHT.format("bad-luck"), "'bad-luck' is no finding; there are mirrored-pose"),
    ],
)
def test_caught_needs_a_finding(tmp_path, top, says):
    with pytest.raises(InputError, match=says):
        spec(tmp_path, FIELD, top)


def test_caught_needs_a_session(tmp_path):
    path = tmp_path / "none.toml"
    text = SMALL.format(top=CAUGHT.format("few-views"), calibration="").replace("[calibration]", "")
    path.write_text(text)
    with pytest.raises(InputError, match=r"needs a \[calibration\]"):
        load_scenario(path)


def test_unknown_cameras_in_faults_are_told(tmp_path):
    for fault, says in (
        ('{ kind = "moved_camera", camera = "left" }', "'left' given; the rig has cam1, cam2, cam3"),
        ('{ kind = "swapped_cameras", cameras = ["cam1", "right"] }', "'right' given"),
    ):
        one = spec(tmp_path, f"{FIELD}\nfault = {fault}")
        rig = true_rig(one, tmp_path)
        cameras = tuple(replace(v) for v in virtual_cameras(one, rig))
        with pytest.raises(InputError, match=says):
            calibrate_in_session(one, cameras, rig, 1)
