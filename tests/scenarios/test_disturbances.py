"""Stated disturbances must be in the truth: jitter, shake, motion and lens gap that are switched off are told."""

from dataclasses import replace

import numpy as np
import pytest
from tiny_scenario import write_tiny

from mosca.errors import PremiseError
from scenarios.run import scenario
from scenarios.spec.scenario import load_scenario


def run(path, *changes):
    return scenario.run_scenario(load_scenario(path, changes), "tiny", path.parent)


def changed_in_the_twin(monkeypatch, change):
    """Let the twin film with other cameras than the scenario states."""
    whole = scenario.twin_source
    stated = []

    def source(spec, scene, cameras, workers):
        made = whole(spec, scene, tuple(change(one) for one in cameras), workers)
        stated.append(cameras)
        made.virtual = cameras
        return made

    monkeypatch.setattr(scenario, "twin_source", source)


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("trigger_jitter_s", lambda v: replace(v, timing=replace(v.timing, jitter_s=0.0))),
        ("trigger_jitter_s", lambda v: replace(v, timing=replace(v.timing, jitter_s=60e-6))),
        ("shake_px", lambda v: replace(v, mount=replace(v.mount, body_px=0.0))),
        ("gap_px", lambda v: replace(v, optics=replace(v.optics, gap_px=0.0))),
    ],
)
def test_a_disturbance_that_is_not_there_as_stated_is_refused(tmp_path, monkeypatch, key, change):
    path = write_tiny(tmp_path)
    changed_in_the_twin(monkeypatch, change)
    with pytest.raises(PremiseError, match=f"premise '{key}' does not hold") as told:
        run(path)
    assert "\n" not in str(told.value)


def test_a_bump_that_does_not_happen_is_refused(tmp_path, monkeypatch):
    path = write_tiny(tmp_path, cameras='[[camera]]\nname = "cam2"\nmount.bump_s = 0.1\nmount.bump_px = [0.6, 0.0]\n')
    found = run(path).record.premises["motion_px"]
    # two thirds of the frames come after it: rms about the mean of one axis of two
    assert found["value"] == pytest.approx(0.6 * np.sqrt(2 / 9) / np.sqrt(2), rel=0.15)
    changed_in_the_twin(monkeypatch, lambda v: replace(v, mount=replace(v.mount, bump_s=None)))
    with pytest.raises(PremiseError, match="motion_px"):
        run(path)


def test_what_is_stated_is_found(tmp_path):
    path = write_tiny(tmp_path)
    found = run(path, "errors.trigger_jitter_s=4e-5", "errors.body_px=0.1", "model_gap=stress").record.premises
    # 4 cameras, 30 frames: 112 and 232 degrees of freedom, three standard deviations of an rms
    assert found["trigger_jitter_s"]["value"] == pytest.approx(4e-5, rel=0.2)
    assert found["shake_px"]["value"] == pytest.approx(0.1, rel=0.14)
    assert found["gap_px"]["value"] > 0.05


def test_jitter_below_the_resolution_of_times_is_not_judged(tmp_path):
    """Times are whole nanoseconds: of 0.2 ns rms there is nothing in the truth."""
    path = write_tiny(tmp_path)
    assert "trigger_jitter_s" not in run(path, "errors.trigger_jitter_s=2e-10").record.premises


def test_one_target_does_not_tell_the_lens_gap(tmp_path):
    """It stands where the gap happens to be small, or not."""
    path = write_tiny(tmp_path)
    assert "gap_px" in run(path).record.premises
    assert "gap_px" not in run(path, "scene.markers=1", "premises.views=1.0").record.premises
