"""Controls measure: none passes with a dead pipeline, a blind camera or an empty scene; sound ones all do."""

from dataclasses import replace

import numpy as np
import pytest
from test_spec import GOOD, complaint

from mosca.continuous.association import frame_detections
from mosca.data.detections import Detections
from mosca.detection import scheduler
from mosca.detection.disc_fit.camera_statistics import NO_STATISTICS
from mosca.errors import MoscaError
from scenarios.build.cameras import true_rig
from scenarios.run import scenario
from scenarios.score.controls import control_verdict
from scenarios.spec.catalog import entries
from scenarios.spec.scenario import load_scenario
from scenarios.types import Score
from twin.source import TwinSource

CONTROLS = {entry.name: entry for entry in entries(()) if entry.spec.expect == "fail"}
QUICK = [name for name, entry in CONTROLS.items() if entry.spec.tier == "quick"]
SHORT = 10
"""Frames of a short run: nothing is detected in it as in a long one."""


def verdict(name, *changes):
    """Whether a control passes, and why; a known error is no pass, any other is a bug."""
    entry = CONTROLS[name]
    try:
        record = scenario.run_scenario(load_scenario(entry.path, changes), name, entry.path.parent).record
    except MoscaError as error:
        return False, str(error)
    return record.passed, record.verdict


def kill_detection(monkeypatch):
    def nothing(images, names, *given, **more):
        return [Detections.none(name) for name in names], NO_STATISTICS

    for stage in (scheduler, frame_detections):
        monkeypatch.setattr(stage, "detect_with_statistics", nothing)


def blind(monkeypatch, camera):
    whole = TwinSource.__iter__

    def frames(self):
        for frame in whole(self):
            lit = frame.camera != camera or frame.image is None
            yield frame if lit else replace(frame, image=np.zeros_like(frame.image))

    monkeypatch.setattr(TwinSource, "__iter__", frames)


def take_markers_away(monkeypatch):
    whole = scenario.build_scene
    none = {"marker_names": (), "marker_geoms": (), "bodies": {}, "figures": {}, "glows": {}}
    monkeypatch.setattr(scenario, "build_scene", lambda *given: replace(whole(*given), **none))


def short(name):
    return f"capture.duration_s={SHORT / CONTROLS[name].spec.capture.frame_rate_hz}"


def cameras_of(name):
    entry = CONTROLS[name]
    return true_rig(entry.spec, entry.path.parent).names


def test_each_control_derives_its_range_and_limits_something_else():
    assert len(CONTROLS) >= 20
    for name, entry in CONTROLS.items():
        assert set(entry.spec.breaks) <= set(entry.spec.limits), name
        assert set(entry.spec.limits) - set(entry.spec.breaks), name
        assert "Range" in entry.spec.description, name


@pytest.mark.parametrize("name", QUICK)
def test_none_passes_with_a_dead_pipeline(name, monkeypatch):
    kill_detection(monkeypatch)
    passed, why = verdict(name, short(name))
    assert not passed
    assert "completeness 0 below" in why or "not measured" in why or "no marker was followed" in why


@pytest.mark.parametrize("name", ["lenses/warming", "mounts/bump", "light/shiny_spot_inside"])
def test_none_passes_with_a_blind_camera(name, monkeypatch):
    blind(monkeypatch, "cam1")
    passed, why = verdict(name)
    assert not passed
    assert "rays_used" in why


@pytest.mark.parametrize("name", ["lenses/warming", "light/shiny_spot_inside", "targets/checkerboard"])
def test_none_passes_without_markers(name, monkeypatch):
    take_markers_away(monkeypatch)
    passed, why = verdict(name, short(name))
    assert not passed
    assert "premise 'marker_px' does not hold" in why


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLS)
def test_none_passes_whatever_is_broken(name, monkeypatch):
    fewer = {}
    for camera in cameras_of(name):
        with monkeypatch.context() as patch:
            blind(patch, camera)
            fewer[f"{camera} is blind"] = verdict(name)
    for broken in (kill_detection, take_markers_away):
        with monkeypatch.context() as patch:
            broken(patch)
            fewer[broken.__name__] = verdict(name)
    assert {how: why for how, (passed, why) in fewer.items() if passed} == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLS)
def test_a_sound_one_lands_in_its_range_for_five_seeds(name):
    found = {seed: verdict(name, f"seed={seed}") for seed in range(1, 6)}
    # zones_two changes identities with seed 4 whether or not its frames are shifted
    known = {4} if name == "controls/shifted_zone" else set()
    assert {seed: why for seed, (passed, why) in found.items() if not passed and seed not in known} == {}


def scores(**values):
    return {name: Score(value, 1) for name, value in values.items()}


@pytest.mark.parametrize(
    ("accuracy", "complete", "passed", "words"),
    [
        (0.0021, 1.0, True, "fails as it must: relative_accuracy 0.0021 in [0.0012, 0.003]"),
        (0.2, 1.0, False, "control broken: relative_accuracy 0.2 outside [0.0012, 0.003]"),
        (0.0001, 1.0, False, "control broken: relative_accuracy 0.0001 outside [0.0012, 0.003]"),
        (0.0021, 0.0, False, "control broken: completeness 0 below its limit 0.99"),
        (float("nan"), 1.0, False, "control broken: relative_accuracy (not measured) outside [0.0012, 0.003]"),
    ],
)
def test_the_verdict_says_where_each_metric_lies(accuracy, complete, passed, words):
    limits = {"relative_accuracy": 0.0003, "completeness": 0.99}
    met = {"relative_accuracy": accuracy <= 0.0003, "completeness": complete >= 0.99}
    found = control_verdict(
        scores(relative_accuracy=accuracy, completeness=complete), limits, met, {"relative_accuracy": (0.0012, 0.003)}
    )
    assert found == (passed, words)


LIMITS = "position_rms = 0.001\ncompleteness = 0.99\n"


@pytest.mark.parametrize(
    ("breaks", "limits", "parts"),
    [
        ("", LIMITS, ["expect = 'fail' without [breaks]", "add", "relative_accuracy = ["]),
        ("position_rms = [0.0009, 0.002]", LIMITS, ["breaks.position_rms", "0.0009", "begin above 0.001"]),
        ("completeness = [0.5, 0.995]", LIMITS, ["breaks.completeness", "0.995", "end below 0.99"]),
        ("position_rmse = [0.002, 0.003]", LIMITS, ["breaks.position_rmse", "position_rms"]),
        ("position_rms = [0.003, 0.002]", LIMITS, ["breaks.position_rms", "[0.003, 0.002]", "smaller one first"]),
        ("position_rms = 0.002", LIMITS, ["breaks.position_rms", "0.002", "[low, high]"]),
        ("nees = [4.0, 5.0]", LIMITS, ["breaks.nees", "add limits.nees"]),
        ("position_rms = [0.002, 0.003]", "position_rms = 0.001\n", ["only what must break", "completeness"]),
    ],
)
def test_a_control_that_cannot_measure_is_refused(tmp_path, breaks, limits, parts):
    control = GOOD.replace('title = "x"', 'title = "x"\nexpect = "fail"').replace("position_rms = 0.001\n", limits)
    line = complaint(tmp_path, f"{control}[breaks]\n{breaks}\n")
    for part in parts:
        assert part in line


def test_ranges_belong_to_controls(tmp_path):
    line = complaint(tmp_path, f"{GOOD}[breaks]\nposition_rms = [0.002, 0.003]\n")
    assert "[breaks] position_rms" in line
    assert "expect = 'fail'" in line
