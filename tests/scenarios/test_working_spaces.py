"""The paper's 0.01 % with two and with three cameras, in each of the five rooms of ``scenarios/library/spaces``."""

from pathlib import Path

import pytest

from scenarios import run_scenario
from scenarios.types import RunOptions

SPACES = Path(__file__).parents[2] / "scenarios/library/spaces"
CLAIM = 1e-4
"""Table 1 of the Mosca paper: 0.01 % of the working space, 2 to 4 cameras."""
AZIMUTHS_DEG = {2: [45.0, 135.0], 3: [45.0, 165.0, 285.0]}
ON_TWO_WALLS_DEG = {2: [0.0, 90.0], 3: [-10.0, 45.0, 100.0]}
"""The hall's cameras look at the marks on its other two walls."""
CLAIMED = ("relative_accuracy", "completeness", "ghosts_per_frame", "identity_switches")
"""Not nees: two cameras have one residual a frame for the shake that they learn (docs/working_spaces.md)."""
ROOMS = ("space_0p1m", "space_0p3m", "space_1m", "space_3m", "space_10m")


@pytest.mark.slow
@pytest.mark.parametrize("count", AZIMUTHS_DEG)
@pytest.mark.parametrize("room", ROOMS)
def test_fewer_cameras_meet_the_claim(room, count):
    azimuths = ON_TWO_WALLS_DEG if room == "space_10m" else AZIMUTHS_DEG
    changes = {"cameras.count": count, "cameras.azimuth_deg": azimuths[count], "limits.relative_accuracy": CLAIM}
    if count == 2:  # they cannot tell which of two targets in one epipolar plane is which, for some frames
        changes |= {"scene.markers": 12, "capture.duration_s": 5.0 if room == "space_0p1m" else 2.0}
    record = run_scenario(SPACES / f"{room}.toml", changes, options=RunOptions(workers=2)).record
    missed = [metric for metric in map(record.metric, CLAIMED) if metric is None or not metric.passed]
    assert not missed, record.verdict
