"""``mosca plan``: what it writes, what it refuses, and that a bad rig is simulated to be as bad as predicted."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import mosca, refusal

from mosca.accuracy.planning.layout import Layout, angles_towards
from mosca.accuracy.planning.search import first_layout
from mosca.data.files.rig_file import read_rig
from scenarios.spec.plan import PlanFile, load_plan
from scenarios.spec.scenario import load_scenario
from scenarios.studies.plan import plan as plans
from scenarios.studies.plan.plan import Plan, PlanSettings, make_plan, task_of
from scenarios.studies.plan.room import (
    inside_polygon,
    is_convex,
    mounts_of,
    obstacles_of,
    options_of,
    points_in,
    room_of,
)
from scenarios.studies.plan.scenario import write_scenario
from scenarios.studies.plan.verify import verify

PLAN = """
title = "small"
{top}
[volume]
center_m = [0.0, 0.0, 1.0]
size_m = [1.5, 1.5, 1.0]
marker_diameter_m = 0.02
[room]
corners_m = [[-2.5, -2.5], [2.5, -2.5], [2.5, 2.5], [-2.5, 2.5]]
mount_heights_m = [1.0, 2.5]
{more}
[[camera]]
model = "small"
size_px = [656, 491]
pixel_pitch_mm = 0.0099
focal_lengths_mm = [5.0, 7.5]
price = 100
[budget]
cameras = 3
{budget}
"""

BODY = '[[obstacle]]\nkind = "{0}"\ncenter_m = [0, 0, 1]\nsize_m = [{1}, {1}, {1}]'


def needs_cma():
    pytest.importorskip("cma", reason="cma is not installed (pip install 'mosca-testbench[plan]')")


def written(folder, top="", more="", budget="", change=("", "")):
    path = folder / "volume.toml"
    path.write_text(PLAN.format(top=top, more=more, budget=budget).replace(*change))
    return path


def document(**changed):
    return PlanFile.model_validate(tomllib.loads(PLAN.format(top="", more="", budget="")) | changed)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    needs_cma()
    folder = tmp_path_factory.mktemp("plan")
    path = written(folder, more='[[obstacle]]\nkind = "box"\ncenter_m = [1.6, 0, 1]\nsize_m = [0.3, 0.3, 2]')
    done = mosca("plan", path, "--evaluations", "300", "--out", "out", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "out", done.stdout


def test_rig_scenario_result_and_page_are_written(made):
    folder, told = made
    assert {one.name for one in folder.iterdir()} == {
        "rig.toml", "scenario.toml", "room.xml", "motion.csv", "result.json", "plan.html",
    }  # fmt: skip
    result = json.loads((folder / "result.json").read_text())
    rig = read_rig(folder / "rig.toml")
    assert [one["name"] for one in result["cameras"]] == list(rig.names)
    assert [one["cameras"] for one in result["curve"]] == [2, 3]
    for row, camera in zip(result["cameras"], rig.cameras, strict=True):
        np.testing.assert_allclose(camera.world_from_camera.translation, row["position_m"], atol=1e-12)
        np.testing.assert_allclose(camera.world_from_camera.rotation[:, 2], row["direction"], atol=1e-12)
    best = result["predicted"]
    assert best["sigma_quantile_m"] < result["evenly_spaced"]["sigma_quantile_m"]
    page = (folder / "plan.html").read_text()
    for word in ("Cameras from above", "How many cameras", "seen by fewer than two"):
        assert word in page
    assert "90 % of the markers" in told


def test_no_plan_is_worse_than_even_spacing(tmp_path, monkeypatch):
    """A search that finds bad layouts: cameras side by side."""
    needs_cma()
    spec = load_plan(written(tmp_path))

    def bad(task, count, **settings):
        first = first_layout(task, count)
        return first.moved(np.full((count, 2), 0.5) + 0.1 * np.arange(count)[:, None], first.angles)

    monkeypatch.setattr("scenarios.studies.plan.plan.search", bad)
    plan = make_plan(spec, PlanSettings(100))
    for count, one in plan.planned.items():
        even = first_layout(task_of(spec, points_in(spec, 160, spec.seed), 0.0), count)
        np.testing.assert_array_equal(one.layout.share, even.share)
    assert plan.best.predicted.quantile_m(0.9) == plan.start.predicted.quantile_m(0.9)


def test_the_scenario_has_the_planned_cameras_and_a_calibration(made):
    folder, _ = made
    spec = load_scenario(folder / "scenario.toml")
    assert spec.session is not None
    assert spec.cameras.rig == "rig.toml"
    assert "obstacle1" in (folder / "room.xml").read_text()


def test_the_same_file_gives_the_same_bytes(tmp_path):
    needs_cma()
    path = written(tmp_path)
    words = ("plan", path, "--evaluations", "200", "--no-curve")
    for name in ("one", "two"):
        assert mosca(*words, "--out", name, cwd=tmp_path).returncode == 0
    for name in ("rig.toml", "result.json", "plan.html"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"change": ("[1.5, 1.5, 1.0]", "[1.5, -1.5, 1.0]")}, "'volume.size_m[1]': -1.5 given; a number greater"),
        ({"change": ("center_m = [0.0, 0.0, 1.0]", "")}, "[volume]: give center_m and size_m of a box, or corners_m"),
        ({"change": ("mount_heights_m = [1.0, 2.5]", "")}, "no place for cameras; give room.mount_heights_m, a"),
        ({"change": ("[1.0, 2.5]", "[2.5, 1.0]")}, "room.mount_heights_m = [2.5, 1.0] given; the lower end first"),
        ({"change": ("cameras = 3", "cameras = 1")}, "'budget.cameras': 1 given; a number greater than"),
        ({"budget": "money = 150"}, "budget.money = 150 given; two of the cheapest cameras cost 200: raise it"),
        ({"more": "[goal]\nseen_by = 4"}, "goal.seen_by = 4 with budget.cameras = 3 given"),
        ({"more": BODY.format("ball", 1)}, "'obstacle[0].kind': 'ball' given; 'box' or 'cylinder' is wanted"),
        ({"more": BODY.format("box", 9)}, "[[obstacle]]: they leave less than a fortieth"),
        ({"change": ("pixel_pitch_mm = 0.0099", "")}, "camera 'small': give sensor, or size_px and pixel_pitch_mm"),
        ({"change": ("size_px = [656, 491]", 'sensor = "sony_imx999"')}, "pixel_pitch_mm is the sensor's own"),
        ({"change": ("price = 100", "prise = 100")}, "unknown key 'camera[0].prise'; did you mean 'price'?"),
        ({"top": "seed = -1"}, "'seed': -1 given"),
        ({"more": "[goal]\nquantile = 1.5"}, "'goal.quantile': 1.5 given"),
    ],
)  # fmt: skip
def test_wrong_input_is_told_in_one_line(tmp_path, changed, told):
    path = written(tmp_path, **changed)
    line = refusal("plan", path, "--out", "new", cwd=tmp_path)
    assert told in line
    assert not (tmp_path / "new").exists()


def test_other_files_and_places(tmp_path):
    written(tmp_path)
    (tmp_path / "rig.toml").write_text('[[camera]]\nname = "a"\nlens = {model = "opencv"}\n')
    assert "rig.toml: is a rig file, not a plan file" in refusal("plan", "rig.toml", cwd=tmp_path)
    assert "volume.toml: is a plan file, not a scenario" in refusal("run", "volume.toml", cwd=tmp_path)
    assert "none.toml: no such file" in refusal("plan", "none.toml", cwd=tmp_path)
    (tmp_path / "there").mkdir()
    assert "there: is there already" in refusal("plan", "volume.toml", "--out", "there", cwd=tmp_path)


def test_an_unknown_sensor_is_named(tmp_path):
    path = written(tmp_path, change=("size_px = [656, 491]\npixel_pitch_mm = 0.0099", 'sensor = "sony_imx99"'))
    assert "sensor 'sony_imx99'" in refusal("plan", path, "--out", "new", cwd=tmp_path)


def test_polygons():
    l_shape = np.array([[0, 0], [4, 0], [4, 2], [2, 2], [2, 4], [0, 4.0]])
    assert inside_polygon(l_shape, np.array([[1, 1], [3, 3], [3, 1], [1, 3]])).tolist() == [True, False, True, True]
    assert not is_convex(l_shape)
    assert is_convex(np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]))


def test_a_prism_and_an_l_shaped_room():
    corners = [[0, 0], [6, 0], [6, 3], [3, 3], [3, 6], [0, 6]]
    spec = document(
        volume={"corners_m": [[0.5, 0.5], [5, 0.5], [0.5, 5]], "heights_m": [0.2, 1.8], "marker_diameter_m": 0.02},
        room={"corners_m": corners, "mount_heights_m": [1.0, 2.5]},
    )
    points = points_in(spec, 200, 1)
    assert (points[:, 0] + points[:, 1] < 5.5 + 1e-9).all()
    assert len(obstacles_of(spec)) == 6
    for mount in mounts_of(spec):
        ends = np.array([mount.start, mount.start + mount.along])[:, :2]
        assert inside_polygon(np.array(corners, float), ends).all()


def one_sided(spec: PlanFile) -> Plan:
    """Return a plan with all cameras on one wall, 0.4 m apart."""
    task = task_of(spec, points_in(spec, 50, 1), 0.0)
    count = spec.budget.cameras
    share = np.column_stack([np.linspace(0.5, 0.5 + 0.4 * (count - 1) / 4.7, count) - 0.13, np.full(count, 0.6)])
    layout = Layout(np.zeros(count, int), share, np.zeros((count, 2)), np.zeros(count, int))
    places = layout.places(task.mounts)
    layout = layout.moved(share, angles_towards(places, np.array([0, 0, 1.0])))
    one = plans._planned(spec, task, layout)
    return Plan(spec, task.options, task.mounts, {count: one}, one)


def test_cameras_on_one_side_are_predicted_to_be_worse():
    needs_cma()
    spec = document()
    good, bad = make_plan(spec, PlanSettings(300, curve=False)), one_sided(spec)
    assert bad.best.predicted.quantile_m(0.9) > 1.5 * good.best.predicted.quantile_m(0.9)


@pytest.mark.slow
def test_cameras_on_one_side_are_simulated_to_be_worse(tmp_path: Path):
    needs_cma()
    spec = document(budget={"cameras": 4})
    found = {}
    for name, plan in {"good": make_plan(spec, PlanSettings(400, curve=False)), "bad": one_sided(spec)}.items():
        folder = tmp_path / name
        folder.mkdir()
        write_scenario(plan, folder)
        found[name], _ = verify(plan, folder, 2)
    assert found["bad"].simulated_rms_m > 1.5 * found["good"].simulated_rms_m
    for one in found.values():
        assert one.ratio == pytest.approx(1.0, abs=0.3)


def test_the_example_of_the_documentation_is_read():
    example = Path(__file__).parents[2] / "docs" / "examples" / "plan_room.toml"
    assert load_plan(example).subject is not None


def test_a_row_of_the_study_says_what_was_found():
    from scenarios.studies.plan.verify import Verified
    from tests.studies.planner_rooms import drawn_room, ratio_of, row

    found = Verified(1e-4, 2e-4, 1.9e-4, 2.1e-4, 3e-4, 3e-4, 0.0, 0.0, 1.0)
    other = replace(found, simulated_rms_m=1e-4)
    assert found.ratio == 0.5
    assert "0.1000     0.2000" in row(0, [found])
    # rms of 0.2 and 0.1 mm
    assert ratio_of([found, other]) == pytest.approx(0.1 / np.sqrt(0.025))
    assert "0.50 1.00" in row(0, [found, other])
    assert drawn_room(3).subject is not None
    assert drawn_room(2).subject is None


def test_markers_so_dense_that_their_images_overlap_are_predicted_to_be_unmeasured():
    """A marker of 20 mm every 16 mm round the body: each image overlaps its neighbours'."""
    needs_cma()
    plan = one_sided(document(budget={"cameras": 4}))
    rows = plan.best.layout.rows(plan.mounts, np.array([one.row for one in options_of(plan.spec)]))
    unseen = {}
    for directions in (4, 64):
        spec = document(subject={"directions": directions, "radius_m": 0.15})
        points = points_in(spec, 40, 1)
        unseen[directions] = plans.predicted_of(spec, plan.best.rig, rows, room_of(spec, points)).unseen(2)
    assert unseen[64] == 1.0
    assert unseen[4] < 0.8
