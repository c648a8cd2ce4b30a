"""The planner's core: predicted noise, covariance, visibility and gradient against other ways to compute them."""

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.stats import mstats

from mosca.accuracy.planning.field_calibration import FREE, OWN, FieldSession, common_covariance, parameter_covariance
from mosca.accuracy.planning.image_noise import PixelNoiseModel, centre_sigma_px, information_table
from mosca.accuracy.planning.layout import CameraOption, Layout, MountingPlace, angles_towards, planned_rig
from mosca.accuracy.planning.objective import Objective, predict
from mosca.accuracy.planning.obstacles import Obstacle, obstacle_rows, sight_clearance
from mosca.accuracy.planning.search import WIDE, PlacementTask, first_layout, refine, search
from mosca.accuracy.planning.views import DEGREES, EXTRA, MarkerRoom, Softness, view_table
from mosca.camera.projection import project
from mosca.data.rig import Pose, Rig
from mosca.errors import InputError

NOISE = PixelNoiseModel(12_000.0, 200.0, 10.0, 20_000 / 255)
TABLE = information_table(NOISE)
OPTION = CameraOption("test", 1280, 1024, 0.0048, 6.0, 1.0, None, 0.6, 0.03, 0)
PILLAR = Obstacle("cylinder", (1.2, 0.6, 1.0), (0.5, 0.5, 2.0))
CUPBOARD = Obstacle("box", (-1.3, 1.0, 0.6), (0.4, 0.7, 1.2), 30.0)


def ring(count, spread=2 * np.pi, radius=4.0, height=2.0, option=OPTION, target=(0.0, 0.0, 1.0)):
    """Return rows and rig of cameras on an arc, aimed at one point."""
    angle = spread * (np.arange(count) + 0.3) / count
    places = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height + 0.3 * np.sin(3 * angle)])
    mounts = tuple(MountingPlace(place, np.zeros(3), np.zeros(3)) for place in places)
    angles = angles_towards(places, np.array(target))
    layout = Layout(np.arange(count), np.zeros((count, 2)), angles, np.zeros(count, int))
    return layout.rows(mounts, np.array([option.row])), planned_rig(layout, mounts, (option,))


def room(points, *, subject=False, obstacles=()):
    """Return a room with these points."""
    angle = 2 * np.pi * np.arange(8) / 8
    normals = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) if subject else np.empty((0, 3))
    return MarkerRoom(points, normals, [0.0, 0.0, 1.0], 0.014, obstacle_rows(obstacles), TABLE[None])


def cloud(count, seed=1):
    return np.random.default_rng(seed).uniform([-1, -1, 0.1], [1, 1, 1.9], (count, 3))


def opencv_pixels(camera, points):
    """Return OpenCV's pixels (n, 2) and depths (n,) of points; the principal point as OpenCV counts it."""
    pose = camera.world_from_camera.inverse()
    scale = camera.lens.c_mm / camera.lens.mx_mm_per_px
    matrix = np.array([[scale, 0, camera.lens.xp_px], [0, scale, camera.lens.yp_px], [0, 0, 1.0]])
    xy = cv2.projectPoints(points.reshape(-1, 1, 3), cv2.Rodrigues(pose.rotation)[0], pose.translation, matrix, None)[
        0
    ]
    return xy.reshape(-1, 2), pose.transform(points)[:, 2]


@pytest.mark.parametrize(("diameter", "blur"), [(2.0, 0.6), (6.0, 0.6), (15.0, 1.2)])
def test_noise_of_a_centre_is_that_of_a_rendered_disc(diameter, blur):
    fine, half = 20, int(diameter / 2 + 8 * blur) + 2
    at = (np.arange(-half * fine, half * fine) + 0.5) / fine
    x, y = np.meshgrid(at, at)
    disc = gaussian_filter((np.hypot(x, y) < diameter / 2).astype(float), blur * fine)

    def image(shift):
        moved = np.roll(disc, shift, axis=1)
        return NOISE.signal_e * moved.reshape(2 * half, fine, 2 * half, fine).mean(axis=(1, 3))

    slope = (image(1) - image(-1)) * fine / 2
    information = np.sum(slope**2 / (NOISE.dark_e2 + image(0)))
    assert centre_sigma_px(NOISE, diameter, blur) == pytest.approx(information**-0.5, rel=0.01)


def test_two_cameras_at_right_angles_have_the_closed_form():
    # each measures its two transverse axes to sigma d / f: the common one twice
    places = np.array([[4.0, 0.0, 1.0], [0.0, 4.0, 1.0]])
    mounts = tuple(MountingPlace(place, np.zeros(3), np.zeros(3)) for place in places)
    angles = angles_towards(places, np.array([0.0, 0.0, 1.0]))
    rows = Layout(np.arange(2), np.zeros((2, 2)), angles, np.zeros(2, int)).rows(mounts, np.array([OPTION.row]))
    found = predict(rows, room([[0.0, 0.0, 1.0]]))
    scale = 6.0 / 0.0048
    sigma_px = np.hypot(centre_sigma_px(NOISE, scale * 0.014 / 4, 0.6), 0.03)
    wanted = (sigma_px * 4 / scale) ** 2 * np.diag([1.0, 1.0, 0.5])
    np.testing.assert_allclose(found.covariance[0, 0], wanted, rtol=2e-3, atol=1e-14)


def test_covariance_is_that_of_least_squares_with_opencv():
    rows, rig = ring(4)
    points = cloud(6)
    found = predict(rows, room(points))
    _, variance = view_table(
        rows, points, np.empty((0, 3)), np.empty((0, 9)), np.array([0, 0, 1.0]), 0.014, TABLE[None], np.zeros(3)
    )

    def pixels(x):
        return np.array([opencv_pixels(one, x.reshape(1, 3))[0][0] for one in rig.cameras])

    for k, point in enumerate(points):
        sigma = np.sqrt(variance[:, k])[:, None]
        steps = 1e-5 * np.eye(3)
        design = np.stack([((pixels(point + s) - pixels(point - s)) / sigma).ravel() / 2e-5 for s in steps], axis=1)
        np.testing.assert_allclose(found.covariance[k, 0], np.linalg.inv(design.T @ design), rtol=1e-3, atol=1e-13)
    draw, errors = np.random.default_rng(2), []
    for _ in range(80):
        measured = pixels(point) + sigma * draw.standard_normal((4, 2))
        fit = least_squares(lambda x, y=measured: ((pixels(x) - y) / sigma).ravel(), point)
        errors.append(fit.x - point)
    # 80 draws of 3 degrees of freedom: a relative standard deviation of 0.1
    assert np.mean(np.sum(np.square(errors), axis=1)) == pytest.approx(found.sigma_m[-1, 0] ** 2, rel=0.3)


def test_gradient_is_that_of_finite_differences():
    option = CameraOption("test", 1280, 1024, 0.0048, 6.0, 1.0, 2.8, 0.6, 0.03, 0)
    rows, _ = ring(5, option=option)
    rows[:, 3] += 0.1
    given = room(cloud(60), subject=True, obstacles=(PILLAR, CUPBOARD))
    objective = Objective(given, 0.9, 3, 2.0, Softness(0.05, 0.05, 0.1))
    value, slope = objective.value_and_slope(rows)
    assert value == objective.value(rows)
    assert slope.shape == (5, DEGREES)
    wanted = np.empty_like(slope)
    for c, d in np.ndindex(slope.shape):
        ends = []
        for step in (1e-6, -1e-6):
            moved = rows.copy()
            moved[c, d] += step
            ends.append(objective.value(moved))
        wanted[c, d] = (ends[0] - ends[1]) / 2e-6
    np.testing.assert_allclose(slope, wanted, atol=3e-4 * np.abs(wanted).max())


def test_who_sees_what_is_as_brute_force_finds():
    rows, rig = ring(6, radius=2.3)
    points = cloud(80)
    given = room(points, subject=True, obstacles=(PILLAR, CUPBOARD))
    seen, _ = view_table(
        rows, given.points, given.normals, given.obstacles, given.center, 0.014, given.tables, Softness().row
    )
    along = np.linspace(0, 1, 3001)[:, None]
    turn = np.deg2rad(30.0)
    for c, camera in enumerate(rig.cameras):
        xy, depth = opencv_pixels(camera, points)
        inside = (depth > 0) & (np.abs(xy - (639.5, 511.5)) < (640, 512)).all(axis=1)
        place = camera.world_from_camera.translation
        for p, point in enumerate(points):
            line = point + along * (place - point)
            pillar = (np.hypot(line[:, 0] - 1.2, line[:, 1] - 0.6) < 0.25) & (np.abs(line[:, 2] - 1.0) < 1.0)
            x, y = line[:, 0] + 1.3, line[:, 1] - 1.0
            u, v = np.cos(turn) * x + np.sin(turn) * y, -np.sin(turn) * x + np.cos(turn) * y
            cupboard = (np.abs(u) < 0.2) & (np.abs(v) < 0.35) & (np.abs(line[:, 2] - 0.6) < 0.6)
            free = inside[p] and not (pillar | cupboard).any()
            facing = given.normals @ (place - point) > 0
            assert (seen[c, p] > 0.5).tolist() == (free & facing).tolist()


def test_clearance_of_a_line_beside_a_cylinder():
    rows = obstacle_rows([Obstacle("cylinder", (0, 0, 0), (1.0, 1.0, 4.0))])
    found = sight_clearance(rows, np.array([[-2.0, 0.8, 0.0], [-2.0, 0.2, 0.0]]), np.array([[2.0, 0.8, 0.0]]))
    assert found[0, 0] == pytest.approx(0.3)
    # from (-2, 0.2) to (2, 0.8): the axis lies 2 / sqrt(4^2 + 0.6^2) from the line
    assert found[0, 1] == pytest.approx(2 / np.hypot(4, 0.6) - 0.5)


def test_weights_of_the_quantile_are_harrell_and_davis():
    objective = Objective(room(cloud(1)), 0.9, 2, 2.0, WIDE)
    values = np.random.default_rng(3).gamma(2.0, size=40)
    found = objective._quantile_weights(40) @ np.sort(values)
    assert found == pytest.approx(float(mstats.hdquantiles(values, 0.9)[0]), rel=1e-9)


def test_cameras_on_one_side_are_predicted_to_be_worse():
    points = cloud(100)
    around = predict(ring(4)[0], room(points))
    beside = predict(ring(4, spread=np.deg2rad(25))[0], room(points))
    assert beside.quantile_m(0.9) > 1.5 * around.quantile_m(0.9)


def test_what_fewer_than_two_see_is_infinite_and_the_objective_is_not():
    rows, _ = ring(2, target=(3.0, 3.0, 1.0))
    given = room(cloud(50))
    found = predict(rows, given)
    assert not np.isfinite(found.quantile_m(0.9))
    assert found.unseen(2) > 0.1
    assert np.isfinite(Objective(given, 0.9, 2, 2.0, WIDE).value(rows))


def four_walls(option=OPTION, money=None, spacing_m=0.5):
    """Return a search over four walls of 6 m and two lenses."""
    corners = [(-3, -3), (3, -3), (3, 3), (-3, 3)]
    mounts = tuple(
        MountingPlace(np.array([*one, 1.0]), np.array([*np.subtract(other, one), 0.0]), np.array([0, 0, 1.5]))
        for one, other in zip(corners, [*corners[1:], corners[0]], strict=True)
    )
    dear = CameraOption("dear", 1280, 1024, 0.0048, 8.0, 5.0, None, 0.6, 0.03, 0)
    objective = Objective(room(cloud(60), subject=True, obstacles=(PILLAR,)), 0.9, 2, 2.0, WIDE)
    return PlacementTask(objective, mounts, (option, dear), money, spacing_m, obstacle_rows([PILLAR]))


def test_the_search_beats_an_even_ring_and_keeps_money_and_distances():
    pytest.importorskip("cma", reason="cma is not installed (pip install 'mosca-testbench[plan]')")
    task = four_walls(money=9.0)
    layout = search(task, 4, evaluations=800, seed=1)
    assert task.allowed(layout)
    assert layout.price(task.options) <= 9.0
    places = layout.places(task.mounts)
    apart = np.linalg.norm(places[:, None] - places, axis=2) + 9 * np.eye(4)
    assert apart.min() > 0.49
    assert task.hard(layout) < task.hard(first_layout(task, 4)) - 0.1


def test_without_the_package_the_search_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(InputError, match=r"needs the package cma; pip install 'mosca-testbench\[plan\]'"):
        search(four_walls(), 3)


def test_refining_never_makes_a_layout_worse():
    task = four_walls()
    layout = first_layout(task, 5)
    assert task.hard(refine(task, layout)) <= task.hard(layout)


def session(**changed):
    draw = np.random.default_rng(4)
    marks = draw.uniform(-0.9, 0.9, (40, 3))
    values = {
        "marks": marks, "stands": (Pose(np.eye(3), np.array([0, 0, 1.0])),), "frames": (1,),
        "seen": np.ones((3, 1, 40), bool), "sigma_px": 0.05, "lasting_px": 0.0, "body_px": 0.0, "known_m": 1e-9,
    }  # fmt: skip
    return FieldSession(**(values | changed))


def test_one_known_stand_is_a_resection_of_each_camera():
    _, rig = ring(3)
    found = parameter_covariance(rig, session())
    camera = rig.cameras[1]
    world = session().marks + [0, 0, 1.0]
    columns = []
    for name in FREE:
        step = 1e-4 if name in ("c_mm", "xp_px", "yp_px") else 1e-7
        ends = [
            project(
                replace(camera, lens=replace(camera.lens, **{name: getattr(camera.lens, name) + k * step})), world
            )
            for k in (1, -1)
        ]
        columns.append((ends[0] - ends[1]).ravel() / (2 * step))
    for axis in range(6):
        ends = []
        for k in (1, -1):
            step = np.zeros(3)
            step[axis % 3] = k * 1e-6
            pose = camera.world_from_camera
            turned = cv2.Rodrigues(step)[0] if axis < 3 else np.eye(3)
            moved = Pose(pose.rotation @ turned, pose.translation + (step if axis >= 3 else 0))
            ends.append(project(replace(camera, world_from_camera=moved), world))
        columns.insert(axis, (ends[0] - ends[1]).ravel() / 2e-6)
    design = np.column_stack(columns)
    # rows in other orders are the same sum; poses are well determined, so that the priors do not matter
    normal = design.T @ design / 0.05**2
    prior = np.linalg.inv(normal + np.diag(_priors()))
    own = found[OWN : 2 * OWN, OWN : 2 * OWN]
    np.testing.assert_allclose(np.sqrt(np.diag(own)), np.sqrt(np.diag(prior)), rtol=1e-3)
    assert np.abs(found[:OWN, OWN : 2 * OWN]).max() < 1e-3 * np.abs(own).max()


def _priors():
    usual = {"c_mm": 1.0, "xp_px": 100.0, "yp_px": 100.0, "my_mm_per_px": 1e-3, "a": 0.01}
    return [1.0] * 6 + [usual.get(name, 1e-3) ** -2 for name in FREE]


def test_shake_marks_and_noise_make_a_calibration_worse():
    _, rig = ring(3)
    points, weights = cloud(20), np.full((3, 20), 0.05**-2)

    def of(**changed):
        covariance = parameter_covariance(rig, session(**changed))
        return np.trace(common_covariance(rig, covariance, points, weights), axis1=1, axis2=2).mean()

    plain = of()
    assert of(sigma_px=0.1) == pytest.approx(4 * plain, rel=0.05)
    assert of(body_px=0.05) > 1.5 * plain
    assert of(known_m=1e-3) > 1.5 * plain


def test_common_error_of_a_rig_that_is_off_as_a_whole():
    # one camera's place is off by dx, dy, dz of one standard deviation each, all cameras alike: so are the points
    rig = Rig(ring(3)[1].cameras)
    covariance = np.zeros((3 * OWN, 3 * OWN))
    for a in range(3):
        for b in range(3):
            for axis in range(3):
                covariance[a * OWN + 3 + axis, b * OWN + 3 + axis] = 1e-6
    found = common_covariance(rig, covariance, cloud(5), np.ones((3, 5)))
    np.testing.assert_allclose(found, np.broadcast_to(1e-6 * np.eye(3), (5, 3, 3)), atol=1e-12)


def test_columns_of_a_row():
    assert OPTION.row[EXTRA] == pytest.approx(0.03**2)
