"""Scenario files: errors are one line that names file, key, value and what is allowed."""

import json
import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosca.data.files.toml import _models_in, check, read_toml
from mosca.data.settings import DetectionSettings, MatchSettings, TrackSettings
from mosca.errors import InputError
from scenarios.build.camera_ring import ring
from scenarios.build.cameras import with_chip
from scenarios.spec.catalog import built_in, entries, find, scenario_name, write_new
from scenarios.spec.new_scenario import SUBJECTS
from scenarios.spec.scenario import PipelineSpec, Scenario, load_scenario, scenario_schema, set_key

GOOD = """
title = "x"
[working_space]
size_m = [1.0, 1.0, 1.0]
[scene]
kind = "cloud"
marker_diameter_m = 0.01
[limits]
position_rms = 0.001
"""


def write(tmp_path, text):
    path = tmp_path / "s.toml"
    path.write_text(text)
    return path


def complaint(tmp_path, text, overrides=()):
    with pytest.raises(InputError) as caught:
        load_scenario(write(tmp_path, text), overrides)
    line = str(caught.value)
    assert "\n" not in line
    assert "s.toml" in line or "--set" in line
    return line


def test_a_good_one_has_the_defaults_of_the_design(tmp_path):
    spec = load_scenario(write(tmp_path, GOOD))
    assert spec.errors.trigger_jitter_s == 20e-6
    assert spec.errors.body_px == 0.03
    assert spec.errors.full_well_e == 20_000
    assert spec.errors.read_noise_e == 10
    assert spec.model_gap == "measured"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (GOOD.replace("size_m", "sise_m"), ["sise_m", "size_m"]),
        (GOOD.replace('kind = "cloud"', 'kind = "clowd"'), ["clowd", "cloud", "actor"]),
        (GOOD.replace("marker_diameter_m = 0.01", ""), ["marker_diameter_m", "missing"]),
        (GOOD.replace("0.01", "-0.01"), ["-0.01", "greater than 0"]),
        (GOOD.replace("position_rms", "position_rmse"), ["position_rmse", "position_rms"]),
        (GOOD.replace("position_rms = 0.001", ""), ["limits", "empty"]),
        (GOOD + "[capture]\nexposure_s = 0.02\n", ["exposure_s", "0.01"]),
        (GOOD + "[cameras]\ncount = 1\n", ["count", "2"]),
        (GOOD + "[cameras]\nazimuth_deg = [1.0, 2.0]\n", ["azimuth_deg", "4"]),
        (GOOD.replace('title = "x"', 'title = "x"\nexpect = "fail"'), ["[breaks]"]),
        (GOOD.replace('title = "x"', 'title = "x'), ["not valid TOML"]),
        (GOOD.replace("size_m = [1.0, 1.0, 1.0]", "size_m = [1.0, 1.0]"), ["size_m"]),
    ],
)
def test_bad_ones(tmp_path, text, parts):
    line = complaint(tmp_path, text)
    for part in parts:
        assert part in line


def test_missing_file_suggests_a_near_name(tmp_path):
    write(tmp_path, GOOD)
    with pytest.raises(InputError, match=r"did you mean '.*s\.toml'"):
        load_scenario(tmp_path / "t.toml")


def test_overrides(tmp_path):
    spec = load_scenario(write(tmp_path, GOOD), ("capture.duration_s=2", "scene.markers=7", "title=other words"))
    assert (spec.capture.duration_s, spec.scene.markers, spec.title) == (2.0, 7, "other words")
    assert "KEY=VALUE" in complaint(tmp_path, GOOD, ("capture.duration_s",))
    assert "title" in complaint(tmp_path, GOOD, ("title.x=1",))
    assert "durration_s" in complaint(tmp_path, GOOD, ("capture.durration_s=2",))


def test_every_built_in_scenario_loads_and_there_are_enough_quick_ones():
    found = entries(())
    assert len(found) == len(built_in())
    quick = [e for e in found if e.spec.tier == "quick"]
    assert sum(e.spec.expect == "pass" for e in quick) >= 9
    assert sum(e.spec.expect == "fail" for e in quick) >= 4


def test_finding_by_name():
    assert scenario_name(find("actor")) == "subjects/actor"
    assert find("subjects/actor") == find("actor")
    with pytest.raises(InputError, match="did you mean 'actor'"):
        find("acter")


@pytest.mark.parametrize("subject", SUBJECTS)
def test_a_new_file_is_a_scenario_of_what_was_chosen(tmp_path, subject):
    path = tmp_path / "mine.toml"
    write_new(path, subject, 5, "0.7 mm")
    spec = load_scenario(path)
    assert (spec.scene.kind, len(ring(with_chip(spec), spec.working_space).cameras)) == (subject, 5)
    assert spec.limits["position_rms"] == pytest.approx(0.0007)
    assert spec.calibration is not None
    # editors find the schema beside it, and it is the one that is printed
    first = path.read_text().splitlines()[0]
    assert json.loads((tmp_path / first.removeprefix("#:schema ")).read_text()) == scenario_schema()
    with pytest.raises(InputError, match="exists already"):
        write_new(path)
    with pytest.raises(InputError, match=r"\.toml"):
        write_new(tmp_path / "mine.txt")


def test_a_claim_is_a_length_or_a_share(tmp_path):
    write_new(tmp_path / "share.toml", claim="0.05 %")
    spec = load_scenario(tmp_path / "share.toml")
    assert spec.limits["relative_accuracy"] == pytest.approx(0.0005)
    assert "position_rms" not in spec.limits
    for claim in ("soon", "1", "-1 mm", "1 kg", '1 mm"', "%"):
        with pytest.raises(InputError, match="--claim"):
            write_new(tmp_path / "bad.toml", claim=claim)
    assert not (tmp_path / "bad.toml").exists()


def test_schema_is_json_and_knows_the_kinds():
    text = json.dumps(scenario_schema())
    for kind in ("actor", "drone", "robot", "cloud", "own"):
        assert f'"{kind}"' in text


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(st.binary(max_size=200))
def test_any_bytes_are_a_known_error(tmp_path, data):
    path = tmp_path / "s.toml"
    path.write_bytes(data)
    with pytest.raises(InputError):
        load_scenario(path)


@pytest.mark.parametrize(
    ("table", "settings"), [("detection", DetectionSettings), ("match", MatchSettings), ("track", TrackSettings)]
)
def test_a_stage_has_the_keys_of_its_settings(table, settings):
    spec = type(getattr(PipelineSpec(), table))
    assert set(spec.model_fields) == set(settings.__dataclass_fields__)
    assert all(field.description for field in spec.model_fields.values())
    defaults = {key: value for key, value in vars(settings()).items() if value not in (None, float("inf"))}
    assert spec(**defaults).model_dump(exclude_none=True) == defaults


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("pipeline.detection.false_alarms=-1", "greater than 0"),
        ("pipeline.match.minimum_cameras=1", "greater than or equal to 2"),
        ("pipeline.track.coast_s=-1", "greater than or equal to 0"),
        ("pipeline.detection.centroid=x", "'refined', 'background' or 'paper'"),
        ("pipeline.track.gate=1", "did you mean 'gate_m'"),
    ],
)
def test_a_stage_has_the_bounds_of_its_settings(key, message):
    with pytest.raises(InputError, match=message):
        load_scenario(find("rigs/three_cameras"), (key,))


WRONG = (
    "x",
    "",
    -1e99,
    1e99,
    0.5,
    True,
    [],
    ["x"],
    [0, 0],
    [-1.0, 2.0, 3.0, 4.0, 5.0],
    {},
    {"kind": "x"},
    float("nan"),
)


def tables(model):
    """The models of a table's keys, each with the dotted key under which it is."""
    for name, field in model.model_fields.items():
        yield name
        for inner in _models_in(field.annotation):
            yield from (f"{name}.{key}" for key in tables(inner))


def test_no_key_of_a_scenario_is_refused_in_the_words_of_pydantic(tmp_path):
    path = write(tmp_path, GOOD)
    refused = 0
    for key in sorted(set(tables(Scenario))):
        for value in WRONG:
            whole = read_toml(path)
            try:
                set_key(whole, key, value, "test")
                check(Scenario, whole, path)
            except InputError as error:
                refused += 1
                line = str(error)
                assert "\n" not in line
                for words in ("Input should", "Value error", "of another kind", "alid ", "tuple["):
                    assert words not in line, line
                assert re.search(r"s\.toml: |test: ", line)
    assert refused > 2000
