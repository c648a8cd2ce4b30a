"""Other trajectory models beside the continuous reconstruction: ``[continuous] compare``."""

import pytest

from mosca.errors import InputError
from scenarios.run.library import run_scenario

SHORT = "continuous/free_running_short"


def test_other_models_are_scored_on_the_same_image_points():
    result = run_scenario(SHORT, {"continuous.compare": ["linear", "cubic"]})
    value = {metric.name: metric.value for metric in result.record.metrics}
    assert "rms_neural" not in value
    # points at 1 m/s, 20 ms between exposures: straight lines miss their curvature, and cubic ones less of it
    assert value["position_rms"] < value["rms_cubic"] < value["rms_linear"] < 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"continuous.compare": ["quintic"]}, "'linear', 'cubic' or 'neural'"),
        ({"limits.rms_cubic": 0.001}, r"limits.rms_cubic needs continuous.compare = \['cubic'\]"),
        (
            {"continuous.compare": ["cubic"], "continuous.moving": True, "continuous.worn_on": "torso"},
            "compare and moving = true",
        ),
    ],
)
def test_wrong_keys_are_named(changes, message):
    with pytest.raises(InputError, match=message):
        run_scenario(SHORT, changes)
