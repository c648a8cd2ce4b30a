"""Limits carry their unit; one that has no meaning is refused, and one that is met far too easily is told of."""

import re

import numpy as np
import pytest
from command_line import mosca, refusal
from tiny_scenario import write_tiny

from mosca.data.tracks import table
from mosca.synchronisation import Assembly
from reports.metrics import METRICS, kind_of
from reports.page import sentence
from reports.record import Metric
from scenarios.build.cameras import Calibrated
from scenarios.run.record import record_of
from scenarios.score.limits import loose_limits, times_looser
from scenarios.spec.limits import UNITS, limits_schema, read_limits
from scenarios.spec.scenario import load_scenario, scenario_schema
from scenarios.types import Collected, Score, Scored


@pytest.mark.parametrize(
    ("line", "limits"),
    [
        ("position_rms = 0.0005", {"position_rms": 0.0005}),
        ('position_rms = "0.5 mm"', {"position_rms": 0.0005}),
        ('position_rms = "500µm"', {"position_rms": 0.0005}),
        ("position_rms_mm = 0.5", {"position_rms": 0.0005}),
        ('relative_accuracy = "0.02 %"', {"relative_accuracy": 0.0002}),
        ("completeness_percent = 99", {"completeness": 0.99}),
        ('reprojection_rms = "3 px"', {"reprojection_rms": 3.0}),
        ('body_angle_rms = "180 deg"', {"body_angle_rms": np.pi}),
        ("latency_p99_ms = 5", {"latency_p99": 0.005}),
        ('frame_rate = "100 Hz"', {"frame_rate": 100.0}),
        ("clock_drift_ppm = 5", {"clock_drift_ppm": 5.0}),
        ("ghosts_per_frame = 0", {"ghosts_per_frame": 0.0}),
        ("completeness = 1", {"completeness": 1.0}),
        ("nees = [2.4, 3.6]", {"nees": (2.4, 3.6)}),
        ("position_rms_mm = [0.2, 0.5]", {"position_rms": (0.0002, 0.0005)}),
    ],
)
def test_units_of_limits(tmp_path, line, limits):
    assert load_scenario(write_tiny(tmp_path, limits=line)).limits == {
        name: pytest.approx(limit, rel=1e-12) for name, limit in limits.items()
    }


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("hota = 98", ["'limits.hota': 98 given", "hota is a share above 0 to 1", '99 % is 0.99, "99 %"']),
        ("completeness = 99", ["'limits.completeness': 99 given", "a share", '99 % is 0.99, "99 %"']),
        ("position_rms = -1", ["'limits.position_rms': -1 given", "a length from 0 to 1000 m", '"0.5 mm"']),
        ("ghosts_per_frame = -1", ["'limits.ghosts_per_frame': -1 given", "a count from 0"]),
        ("position_rms_mm = -1", ["'limits.position_rms_mm': -1 given", "from 0 to 1000 m"]),
        ("position_rms_px = 1", ["'limits.position_rms_px'", "position_rms_mm"]),
        ("position_rms = 5000", ["5000 given", "to 1000 m"]),
        ('position_rms = "0.5 px"', ["'0.5 px' given", "m, cm, mm, um"]),
        ('position_rms = "0,5 mm"', ["'0,5 mm' given", "m, cm, mm, um"]),
        ('position_rms = "0.5"', ["'0.5' given", "with a unit"]),
        ('position_rms_mm = "0.5 mm"', ["a number is wanted"]),
        ("position_rms = 1e-3\nposition_rms_mm = 0.5", ["'position_rms' limits position_rms already"]),
        ("nees = [3.6, 2.4]", ["[3.6, 2.4] given", "the smaller one first"]),
        ("nees = [2.4]", ["two numbers"]),
        ("completeness = [0.9, 99]", ["a share above 0 to 1"]),
        ("completeness = true", ["True given", "a number is wanted"]),
        ("completeness = 0", ["0 given", "a lower limit of 0 is never broken"]),
        ("frame_rate = inf", ["inf given"]),
        ("nees = nan", ["nan given"]),
        ("nees = []", ["[] given"]),
        ("efficiency.detect = 0.9", ["'efficiency.detect' is no metric", "'efficiency_detection'"]),
        ("position_rmse = 0.1", ["'position_rmse' is no metric", "'position_rms'"]),
    ],
)
def test_limits_without_meaning_are_refused(tmp_path, line, told):
    write_tiny(tmp_path, limits=line)
    refused = refusal("run", "tiny.toml", "--out", "out", cwd=tmp_path)
    for part in ("tiny.toml: key 'limits", *told):
        assert part in refused
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_has_a_range_and_units_that_are_its_own(name):
    kind = METRICS[name]
    assert not kind.allows(-1.0)
    assert not kind.allows(np.inf)
    assert kind.allows(0.0) == (kind.sense == "at_most")
    assert kind.allows(min(1.0, kind.highest))
    own = [factor for unit, factor in UNITS[kind.quantity].items() if unit == kind.unit]
    assert own == ([] if kind.unit == "1" else [1.0])


def test_a_stage_is_read_as_the_metric_that_it_belongs_to():
    assert kind_of("efficiency.detect") == kind_of("efficiency_match") == METRICS["efficiency"]
    assert kind_of("efficiencies") is None


def test_the_schema_allows_what_is_read(tmp_path):
    schema = limits_schema()
    assert scenario_schema()["properties"]["limits"]["properties"] == schema["properties"]
    for key, value, good in (
        ("position_rms", "0.5 mm", True),
        ("position_rms", "0.5 px", False),
        ("completeness", "99 %", True),
        ("completeness", "99", False),
        ("ghosts_per_frame", "3 px", False),
    ):
        patterns = [one["pattern"] for one in schema["properties"][key]["anyOf"] if one["type"] == "string"]
        assert any(re.search(pattern, value) for pattern in patterns) == good
        if good:
            read_limits({key: value})
    assert schema["properties"]["position_rms_mm"]["anyOf"][0]["maximum"] == pytest.approx(1e6)
    assert schema["properties"]["hota"]["anyOf"][0] == {"type": "number", "exclusiveMinimum": 0, "maximum": 1.0}


@pytest.mark.parametrize(
    ("name", "value", "limit", "n", "times"),
    [
        ("position_rms", 2.5e-4, 0.5, 100, 2000.0),
        ("position_rms", 2.5e-4, 3e-4, 100, 1.2),
        ("completeness", 0.99, 0.011, 100, 90.0),
        ("ghosts_per_frame", 0.0, 3.0, 100, 100.0),  # none in 100 frames: at most 3 in 100 (rule of three)
        ("ghosts_per_frame", 0.0, 0.0, 100, 0.0),
        ("identity_switches", 0.0, 9.0, 100, 3.0),
        ("clock_frames", 0.0, 0.05, 2, 0.0),
        ("sets_complete", 0.35, 0.0, 100, 0.0),  # where bursts may hit every set
    ],
)
def test_how_much_looser_a_limit_is(name, value, limit, n, times):
    kind = METRICS[name]
    metric = Metric(name, value, kind.unit, n, limit=limit, sense=kind.sense, passed=True)
    assert times_looser(metric) == pytest.approx(times)


def test_a_broken_limit_and_one_that_is_not_there_are_not_loose():
    broken = Metric("position_rms", 1.0, "m", 9, limit=1e-3, passed=False)
    assert loose_limits([broken, Metric("position_rms", 1.0, "m", 9)], 1.5) == []


def record(tmp_path, limits, loose=""):
    spec = load_scenario(write_tiny(tmp_path, limits=limits, top=loose))
    collected = Collected(table([]), (), -1, Assembly(), {}, {})
    worth = Scored({"position_rms": Score(2.2e-4, 100)}, {}, collected, None, None)
    return record_of(spec, "tiny", "twin", worth, {}, Calibrated(None, 0.0, 0.0))


@pytest.mark.parametrize(
    ("limits", "passes"),
    [("[0.2, 0.3]", True), ("[0.1, 0.2]", False), ("[0.23, 0.3]", False)],  # too small an error is no result either
)
def test_a_limit_with_two_ends(tmp_path, limits, passes):
    made = record(tmp_path, f"position_rms_mm = {limits}")
    assert made.passed == passes
    assert made.metric("position_rms").as_it_must == passes
    assert made.metric("position_rms").limit == pytest.approx(float(limits[1:-1].split(",")[1]) * 1e-3)


def test_a_far_too_loose_limit_is_told_in_the_verdict_and_on_the_page(tmp_path):
    told = "position_rms: limit 500 mm is 2,270 times looser than the measured 0.22 mm"
    made = record(tmp_path, "position_rms = 0.5")
    assert made.passed
    assert told in made.verdict
    assert told in sentence(made)


@pytest.mark.parametrize(
    ("limits", "loose", "is_told"),
    [
        ('position_rms = "4.5 mm"', "", True),
        ('position_rms = "4.3 mm"', "", False),
        ('position_rms = "4.3 mm"', "loose_limit = 10", True),
        ('position_rms = "4.5 mm"', "loose_limit = 40", False),
    ],
)
def test_how_loose_is_told_is_a_setting(tmp_path, limits, loose, is_told):
    assert ("looser" in record(tmp_path, limits, loose).verdict) == is_told


def test_the_terminal_tells_it_and_the_run_passes(tmp_path):
    write_tiny(tmp_path, limits="position_rms = 0.5")
    done = mosca("run", "tiny.toml", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "position_rms: limit 500 mm is" in done.stdout
    assert "times looser than the measured" in (tmp_path / "out" / "report.html").read_text()
