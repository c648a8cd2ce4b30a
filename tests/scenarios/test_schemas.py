"""Schemas for editors: every key says what it is."""

from typing import Literal

import pytest

from mosca.accuracy.acceptance.artefact import acceptance_schema
from mosca.data.files.rig_file import rig_schema
from mosca.data.files.target_file import target_schema
from mosca.data.files.toml import Table, described
from mosca.formats.bodies.model_file import model_schema
from scenarios.spec.claim import claim_schema
from scenarios.spec.plan import plan_schema
from scenarios.spec.scenario import scenario_schema


@pytest.mark.parametrize(
    "made", [scenario_schema, claim_schema, plan_schema, acceptance_schema, rig_schema, target_schema, model_schema]
)
def test_every_key_is_described(made):
    schema = made()
    tables = {"": schema, **schema.get("$defs", {})}
    keys = {
        f"{name}.{key}": entry for name, table in tables.items() for key, entry in table.get("properties", {}).items()
    }
    assert len(keys) >= 5
    assert [name for name, entry in keys.items() if not entry.get("description")] == []


def test_a_table_that_says_nothing_of_a_key_says_what_the_table_is():
    class Inner(Table):
        """A box. It has edges.

        And more.
        """

        kind: Literal["box"] = "box"

    class Outer(Table):
        one: Inner | None = None
        many: tuple[Inner, ...] = ()
        number: int = 0

    schema = described(Outer.model_json_schema())
    keys = schema["properties"]
    assert schema["$defs"]["Inner"]["properties"]["kind"]["description"] == "A box."
    assert (keys["one"]["description"], keys["many"]["description"]) == ("A box.", "A box.")
    assert "description" not in keys["number"]
