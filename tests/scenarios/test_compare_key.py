"""Other trajectory models beside the continuous reconstruction: ``[continuous] compare``."""

import pytest

from mosca.errors import InputError
from scenarios.run.library import run_scenario

SHORT = "continuous/free_running_short"


@pytest.mark.slow
def test_other_models_are_scored_on_the_same_image_points():
    result = run_scenario(SHORT, {"continuous.compare": ["linear", "cubic"]})
    value = {metric.name: metric.value for metric in result.record.metrics}
    assert "rms_neural" not in value
    # points at 1 m/s, 20 ms between exposures: straight lines miss 0.5 mm of the paths, cubic ones little; they do
    # not average over exposures
    assert value["position_rms"] < value["rms_cubic"] < 1.5 * value["position_rms"]
    assert value["rms_linear"] > 3 * value["rms_cubic"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"continuous.compare": ["quintic"]}, "'linear', 'cubic' or 'neural'"),
        ({"limits.rms_cubic": 0.001}, r"limits.rms_cubic needs continuous.compare = \['cubic'\]"),
        ({"limits.sets_complete": 0.9}, r"not measured with \[continuous\]; limit frames_complete"),
        (
            {"continuous.compare": ["cubic"], "continuous.moving": True, "continuous.worn_on": "torso"},
            "compare and moving = true",
        ),
    ],
)
def test_wrong_keys_are_named(changes, message):
    with pytest.raises(InputError, match=message):
        run_scenario(SHORT, changes)


def test_frames_of_triggered_cameras_are_limited_as_sets():
    with pytest.raises(InputError, match=r"not measured without \[continuous\]; limit sets_complete"):
        run_scenario("controls/none", {"limits.frames_complete": 0.9})
