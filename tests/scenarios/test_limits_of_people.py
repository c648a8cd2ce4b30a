"""Limits of the actors' markers: what the page derives and the scenarios state are one."""

import re
from pathlib import Path

import pytest

from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario

PAGE = Path(__file__).parents[2] / "docs" / "people.md"
ROW = re.compile(r"^\| `(subjects/\w+)` \|(.*)\|$", re.MULTILINE)
CLAIM, FACTOR, LOOSEST = 1e-4, 1.5, 1.5
"""The paper's share of the working space; times the bound and the worst of five seeds, at most."""


@pytest.mark.parametrize("name", ["actor", "boxing", "dance", "jump"])
def test_limits_are_those_of_the_page_and_of_its_bound(name: str) -> None:
    rows = {row[0]: [cell.strip() for cell in row[1].split("|")] for row in ROW.findall(PAGE.read_text("utf-8"))}
    cameras, bound, limit, rms, largest, most = rows[f"subjects/{name}"][:6]
    spec = load_scenario(find(f"subjects/{name}"))
    limits = spec.limits
    assert len(load_scenario(find(f"subjects/{name}")).cameras.azimuth_deg) == int(cameras)
    assert limits["position_rms"] == pytest.approx(float(limit.removesuffix(" mm")) * 1e-3)
    assert limits["position_max"] == pytest.approx(float(most.removesuffix(" mm")) * 1e-3)
    assert limits["position_rms"] == pytest.approx(CLAIM * max(spec.working_space.size_m))
    assert (
        float(bound.removesuffix(" mm"))
        < float(limit.removesuffix(" mm"))
        < FACTOR * float(bound.removesuffix(" mm"))
    )
    for stated, of_seeds in ((limit, rms), (most, largest)):
        worst = float(of_seeds.removesuffix(" mm").split(" to ")[1])
        assert worst <= float(stated.removesuffix(" mm")) <= LOOSEST * worst + 1e-9
