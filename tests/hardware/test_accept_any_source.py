"""One acceptance test, three sources: the twin, its recording, and GigE Vision devices fed with its frames."""

from pathlib import Path

import pytest
from needs import needs_aravis
from test_any_source import served

from mosca.accuracy.acceptance.artefact import read_acceptance
from mosca.accuracy.acceptance.evaluate import accept_tracks
from scenarios.run.folder import write_run
from scenarios.run.scenario import run_scenario
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario
from scenarios.studies.acceptance.take import AcceptOptions, take_of
from scenarios.types import RunOptions

SCENARIO = "acceptance/ball_bar"
SHORTER = ("capture.frame_rate_hz=25", "capture.duration_s=2.4")
"""Three of the seven lines, at half the pace: software triggers skip a pulse where a busy machine is late."""
LENGTHS, FEWEST = 15, 10
"""Test lengths on three lines, and how many of them a machine that skips pulses must leave."""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """The twin's errors and the recording of its frames."""
    folder = tmp_path_factory.mktemp("acceptance")
    path = find(SCENARIO)
    options = RunOptions(workers=2, record_to=folder / "take")
    result = run_scenario(load_scenario(path, SHORTER), SCENARIO, path.parent, options)
    write_run(result, folder / "twin")
    return errors_of(result.tracks), folder / "take"


def errors_of(tracks):
    """Return (line, markers) -> error with its expanded uncertainty [m]."""
    given = read_acceptance(find(SCENARIO).with_suffix(".acceptance"))
    found = accept_tracks(tracks, given, None, "take").lengths
    return {
        (one.line, one.markers): (one.error_m, one.decided.expanded)
        for one in found.errors
        if one.error_m is not None
    }


def agree(some, others, fewest):
    """Each length's errors lie within their expanded uncertainties of each other."""
    both = some.keys() & others.keys()
    assert len(both) >= fewest
    for key in both:
        (one, reach), (other, other_reach) = some[key], others[key]
        assert abs(one - other) <= (reach**2 + other_reach**2) ** 0.5, key


def accepted(options, out):
    return errors_of(take_of(options, out, lambda done, total: None).tracks)


def test_the_recording_run_as_the_scenario(taken, tmp_path):
    twin, recording = taken
    found = accepted(AcceptOptions(SCENARIO, source=f"recording:{recording}", overrides=SHORTER), tmp_path)
    assert len(found) == LENGTHS
    # the same frames through the same code
    assert found == twin


def test_the_recording_reconstructed_without_the_scenario(taken, tmp_path):
    twin, recording = taken
    artefact = find(SCENARIO).with_suffix(".acceptance")
    found = accepted(AcceptOptions(str(recording), artefact=artefact), tmp_path)
    agree(twin, found, LENGTHS)


def test_the_devices(taken, tmp_path: Path):
    needs_aravis()
    twin, recording = taken
    with served(recording, tmp_path / "rig.toml", "Software") as rig:
        found = accepted(AcceptOptions(SCENARIO, source=f"hardware:{rig}", overrides=SHORTER), tmp_path)
    agree(twin, found, FEWEST)


def test_errors_that_differ_by_more_than_their_uncertainties_are_told(taken):
    twin, _ = taken
    moved = {key: (error + 2 * reach, reach) for key, (error, reach) in twin.items()}
    with pytest.raises(AssertionError):
        agree(twin, moved, LENGTHS)
