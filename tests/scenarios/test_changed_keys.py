"""What differs from a scenario's file is known, with the defaults of what the file leaves out."""

from pathlib import Path

from scenarios.spec.catalog import find
from scenarios.spec.scenario import changed_keys, load_scenario


def test_changes_are_named_with_both_values() -> None:
    path = find("actor")
    spec = load_scenario(path, ("capture.duration_s=2", "seed=9", "pipeline.fill_s=0.1"))
    assert changed_keys(path, spec) == {
        "seed": (load_scenario(path).seed, 9),
        "capture.duration_s": (10.0, 2.0),
        "pipeline.fill_s": (None, 0.1),
    }
    assert changed_keys(path, load_scenario(path)) == {}


def test_a_value_set_as_it_was_is_no_change() -> None:
    path = find("actor")
    assert changed_keys(path, load_scenario(path, ("capture.duration_s=10",))) == {}


def test_a_file_that_is_no_scenario_alone_has_no_changes(tmp_path: Path) -> None:
    whole = find("actor").read_text("utf-8")
    path = tmp_path / "s.toml"
    path.write_text(whole.replace("duration_s = 10", "duration_s = -1"))
    assert path.read_text() != whole
    assert changed_keys(path, load_scenario(path, ("capture.duration_s=2",))) == {}
