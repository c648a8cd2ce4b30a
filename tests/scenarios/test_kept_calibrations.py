"""A session's calibration is made once for all that have the same cameras at rest, and only for these."""

import threading
from dataclasses import dataclass, replace

import numpy as np
import pytest

from scenarios.build.cameras import calibrated, true_rig, virtual_cameras
from scenarios.run import kept_calibrations as module
from scenarios.run.kept_calibrations import kept, key_of
from scenarios.run.scenario import run_scenario
from scenarios.session.estimated import at_rest, inputs_of
from scenarios.spec.catalog import LIBRARY, built_in, scenario_name
from scenarios.spec.scenario import load_scenario

LIMITED = {
    "position_rms",
    "position_p95",
    "position_max",
    "relative_accuracy",
    "nees",
    "coverage95",
    "body_position_rms",
}


@dataclass(frozen=True)
class Made:
    """Stands for a calibration."""

    number: float


def counted(calls, number=1.0):
    def made():
        calls.append(number)
        return Made(number)

    return made


def key(name, *overrides):
    path = LIBRARY / f"{name}.toml"
    spec = load_scenario(path, overrides)
    cameras = virtual_cameras(spec, true_rig(spec, path.parent))
    return key_of(inputs_of(spec, cameras, calibrated(spec, cameras).rig))


def test_equal_inputs_are_made_once(tmp_path):
    calls = []
    first = kept((1, "a", np.arange(3.0), None, {"k": 2.5}), counted(calls), tmp_path)
    again = kept((1, "a", np.arange(3.0), None, {"k": 2.5}), counted(calls, 2.0), tmp_path)
    assert first == again == Made(1.0)
    assert calls == [1.0]


@pytest.mark.parametrize(
    "other",
    [
        (1, "a", np.arange(3.0), None, {"k": 2.6}),
        (1, "a", np.arange(3), None, {"k": 2.5}),
        (1, "a", np.array([[0.0, 1.0, 2.0]]), None, {"k": 2.5}),
        (1, "a", np.arange(3.0), 0.0, {"k": 2.5}),
        (1.0, "a", np.arange(3.0), None, {"k": 2.5}),
        (1, ("a", np.arange(3.0)), None, {"k": 2.5}),
    ],
)
def test_other_inputs_have_another_key(other):
    assert key_of(other) != key_of((1, "a", np.arange(3.0), None, {"k": 2.5}))


def test_what_has_no_digest_is_refused():
    with pytest.raises(TypeError, match="has no digest"):
        key_of((object(),))


@pytest.mark.parametrize(
    "damage", [lambda whole: whole[:-1], lambda whole: b"", lambda whole: whole[:40] + b"x" + whole[41:]]
)
def test_a_damaged_file_is_made_again(tmp_path, damage):
    calls = []
    kept("x", counted(calls), tmp_path)
    (path,) = tmp_path.glob("*.calibration")
    path.write_bytes(damage(path.read_bytes()))
    assert kept("x", counted(calls, 2.0), tmp_path) == Made(2.0)
    assert kept("x", counted(calls, 3.0), tmp_path) == Made(2.0)


def test_several_at_once_make_it_once(tmp_path):
    calls, begun = [], threading.Barrier(4)

    def run():
        begun.wait()
        kept("x", counted(calls), tmp_path)

    threads = [threading.Thread(target=run) for _ in range(4)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert len(calls) == 1


def test_without_a_place_to_keep_it_the_run_goes_on(tmp_path, caplog):
    (tmp_path / "file").write_text("")
    assert kept("x", counted([]), tmp_path / "file" / "below") == Made(1.0)
    assert "not kept" in caplog.text


def test_the_last_used_ones_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MOST_KEPT", 3)
    for number in range(5):
        kept(number, counted([]), tmp_path)
    assert len(list(tmp_path.glob("*.calibration"))) == 3


def test_what_happens_after_the_session_does_not_decide_it():
    one = key("controls/none")
    # a turned camera, late exposures, drift, warming, dust, lost frames: the cameras at rest are the same
    for name in ("controls/turned_camera", "controls/shifted_clock", "mounts/drift", "lenses/warming", "light/dust"):
        assert key(name) == one, name
    for name in ("lenses/model_gap_stress", "rigs/three_cameras", "sensors/hot_and_dead_pixels"):
        assert key(name) != one, name
    for override in ("seed=2", "calibration.stands=9", "cameras.c_mm=7.1", "errors.body_px=0.02"):
        assert key("controls/none", override) != one, override


def test_cameras_at_rest_keep_lens_sensor_and_shake():
    path = LIBRARY / "mounts/drift.toml"
    spec = load_scenario(path, ("optics.principal_distance_ppm_per_s=500.0",))
    cameras = virtual_cameras(spec, true_rig(spec, path.parent))
    for before, after in zip(cameras, at_rest(cameras), strict=True):
        assert after.mount.drift_px_per_s == (0.0, 0.0)
        assert after.mount.body_px == before.mount.body_px
        assert after.sensor == before.sensor
        assert after.optics == replace(before.optics, principal_distance_ppm_per_s=0.0)


def test_a_scenario_says_whether_its_rig_is_estimated(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = LIBRARY / "delivery/reordered.toml"
    estimated = run_scenario(
        load_scenario(path, ("calibration.stands=4", "capture.duration_s=0.1")), "x", path.parent
    )
    true = run_scenario(load_scenario(path, ("calibration.target=none", "capture.duration_s=0.1")), "x", path.parent)
    assert estimated.record.rig == "estimated from a field"
    assert true.record.rig == "true"
    assert estimated.calibration is not None
    assert true.calibration is None
    assert len(list((tmp_path / "mosca-testbench" / "calibrations").glob("*.calibration"))) == 1


def test_quick_scenarios_measure_with_estimated_rigs():
    # the others say in a comment why not
    true = set()
    for path in built_in():
        spec = load_scenario(path)
        if spec.tier == "quick" and LIMITED & set(spec.limits) and spec.session is None:
            true.add(scenario_name(path))
            assert 'calibration]\ntarget = "none"' in path.read_text(), path
    assert true == {"lenses/fisheye_190", "controls/wrong_lens"}
