"""Artefacts of the acceptance scenarios: certificates, models, paths and stretches are of one bar."""

from pathlib import Path

import acceptance_paths as paths
import mujoco
import numpy as np
import pytest

from mosca.accuracy.acceptance.artefact import read_acceptance
from mosca.errors import InputError
from scenarios.run.acceptance import acceptance_scores
from scenarios.spec.catalog import find
from scenarios.spec.scenario import load_scenario

FOLDER = Path(find("acceptance/ball_bar")).parent


@pytest.mark.parametrize(("made", "name"), [(paths.ball_bar, "ball_bar"), (paths.cluster_bar, "cluster_bar")])
def test_the_tables_of_poses_are_those_that_were_made(made, name):
    ours = np.loadtxt(FOLDER / f"{name}.csv", delimiter=",", skiprows=1)
    theirs = np.array([[float(cell) for cell in line.split(",")] for line in made()[0].text().splitlines()[1:]])
    # sines differ in last digits between machines
    np.testing.assert_allclose(ours, theirs, atol=2e-9)


@pytest.mark.parametrize("name", ["ball_bar", "cluster_bar"])
def test_the_certificate_is_of_the_model(name):
    given = read_acceptance(FOLDER / f"{name}.acceptance")
    model = mujoco.MjModel.from_xml_path(str(FOLDER / f"{name}.xml"))
    places = {model.geom(k).name: np.array(model.geom(k).pos) for k in range(model.ngeom) if model.geom(k).name}
    for body in given.body:
        for marker, place in zip(body.markers, body.positions_m, strict=True):
            np.testing.assert_allclose(place, places[marker], atol=1e-9)
    for bar in given.bar:
        for one in bar.length:
            a, b = (places[marker] for marker in one.markers)
            assert np.linalg.norm(a - b) == pytest.approx(one.length_m, abs=1e-9)
    if given.clusters is not None:
        middles = [given.body_of(name).positions.mean(axis=0) for name in (given.clusters.left, given.clusters.right)]
        assert np.linalg.norm(middles[1] - middles[0]) == pytest.approx(0.3, abs=1e-6)


def test_the_wrong_certificate_is_wrong_in_one_length():
    sound, wrong = (read_acceptance(FOLDER / f"{name}.acceptance") for name in ("ball_bar", "wrong_certificate"))
    differ = [
        b.length_m - a.length_m
        for a, b in zip(sound.bar[0].length, wrong.bar[0].length, strict=True)
        if a.length_m != b.length_m
    ]
    assert differ == pytest.approx([0.0008])
    assert sound.line == wrong.line


def test_lines_lie_where_the_bar_rests():
    given = read_acceptance(FOLDER / "ball_bar.acceptance")
    _, stretches = paths.ball_bar()
    for line in given.line:
        begin, end = stretches[line.name]
        assert begin < line.time_s[0] < line.time_s[1] < end
    assert {line.name for line in given.line} == set(stretches)
    given = read_acceptance(FOLDER / "cluster_bar.acceptance")
    for one, (path, orientation, motion, (begin, end)) in zip(
        given.clusters.path, paths.cluster_bar()[1], strict=True
    ):
        assert (one.path, one.orientation, one.motion) == (path, orientation, motion)
        assert begin <= one.time_s[0] + 1e-9
        assert one.time_s[1] <= end + 1e-9


def test_a_scenario_limits_what_its_acceptance_test_gives():
    path = find("acceptance/ball_bar")
    spec = load_scenario(path)
    with pytest.raises(InputError, match=r"limits.cluster_error_share needs an acceptance test; add \[acceptance\]"):
        load_scenario(find("spaces/space_1m"), ("limits.cluster_error_share=1.0",))
    from mosca.data.tracks import Tracks

    # without tracks there is no score, and a limit without a score is broken
    scores, notes = acceptance_scores(spec, path.parent, Tracks.none())
    assert scores == {}
    assert notes == ["ball_bar.acceptance: no measured samples; an acceptance test needs tracks of the artefact"]
