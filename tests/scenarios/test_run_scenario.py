"""Scenarios run from Python, with changed keys."""

import numpy as np
import pytest

from mosca.errors import InputError
from scenarios.run.library import run_scenario


def test_keys_are_changed_by_a_mapping_and_by_keywords():
    result = run_scenario("rigs/three_cameras", {"capture.duration_s": 0.2}, scene__markers=12, seed=7)
    parameters = result.record.provenance["parameters"]
    assert parameters["capture"]["duration_s"] == 0.2
    assert parameters["scene"]["markers"] == 12
    assert result.record.seed == 7
    assert result.record.scenario == "rigs/three_cameras"
    assert result.truth is not None
    assert result.truth.xyz.shape == (20, 12, 3)
    assert len(np.unique(result.tracks.track)) == 12
    sensor = result.record.cameras["cam1"]["sensor"]
    assert (sensor["images"], sensor["bits"], sensor["step_dn"]) == (20, 8, 1)
    # the twin's by its data sheet: 251 DN for 20,000 e-, dark noise of 10 e- and 200 e- of background
    assert sensor["stated"]["gain_dn_per_e"] == pytest.approx(251 / 20_000)
    assert sensor["stated"]["noise_dn"] == pytest.approx(251 / 20_000 * 300**0.5, rel=0.05)
    assert sensor["noise_dn"] == [0.5, 0.0, 0.5]


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("rigs/three_camera", {}, "did you mean 'rigs/three_cameras'"),
        ("rigs/three_cameras", {"cameras.cuont": 4}, "cameras.cuont"),
        ("rigs/three_cameras", {"title.x": 4}, "title.x = 4: 'title' is a value, not a table"),
    ],
)
def test_wrong_names_and_keys_are_named(name, changes, message):
    with pytest.raises(InputError, match=message):
        run_scenario(name, changes)
