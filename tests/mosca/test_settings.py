"""Settings of the stages as TOML tables: bounds, and errors that name key, value and what is allowed."""

import pytest
from pydantic import ValidationError

from mosca.data.files.toml import Table, check
from mosca.diagnostics.camera_health import HealthSettings
from mosca.errors import InputError
from mosca.tracking.tracker import TrackSettings


class Settings(Table):
    track: TrackSettings = TrackSettings()
    health: HealthSettings = HealthSettings()


def test_a_table_of_settings_gives_the_stage_its_settings() -> None:
    given = check(Settings, {"track": {"gate_m": 1, "model": "velocity"}}, "here.toml")
    assert given == Settings(track=TrackSettings(gate_m=1.0, model="velocity"))


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({"track": {"gate": 1}}, "here.toml: unknown key 'track.gate'; did you mean 'gate_m'?"),
        ({"track": {"coast_s": -1}}, "here.toml: key 'track.coast_s': -1 given; a number greater than"),
        ({"track": {"model": "still"}}, "here.toml: key 'track.model': 'still' given; 'acceleration' or 'velocity'"),
        ({"health": {"every": 0}}, "here.toml: key 'health.every': 0 given; a number greater than 0"),
        ({"track": {"gate_m": float("inf")}}, "here.toml: key 'track.gate_m': inf given; a finite number"),
    ],
)
def test_wrong_settings_are_named(table: dict[str, object], text: str) -> None:
    with pytest.raises(InputError) as error:
        check(Settings, table, "here.toml")
    assert str(error.value).startswith(text)


def test_fields_carry_their_docstrings_and_frozen_settings_stay() -> None:
    properties = Settings.model_json_schema()["$defs"]["TrackSettings"]["properties"]
    assert properties["limb_m"]["description"].startswith("How far limb mates may be")
    with pytest.raises(ValidationError):
        TrackSettings(gate_sigma=0.0)
