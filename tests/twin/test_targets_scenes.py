"""Scenes of targets: each is exactly where the vocabulary has it. (What all scenes promise: test_scenes_contract.)"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scene_poses import body_pose

from mosca.data.boards import Board
from mosca.data.files.target_text import target_toml
from mosca.data.targets import BallTarget, CodedTarget, RoundTarget, ScaleBar, face_axes
from mosca.data.wands import LFrame, Wand
from mosca.errors import InputError
from twin.scenes.emission import Glow
from twin.scenes.field_layout import lay_out_field
from twin.scenes.scene import MARKER_GROUP, Scene
from twin.scenes.target_boards import board_figure, build_board, default_board
from twin.scenes.target_field import build_field
from twin.scenes.target_lamps import build_light_marker
from twin.scenes.target_motion import CarriedPath
from twin.scenes.target_plate import PAPER, RETRO
from twin.scenes.target_wand import (
    build_l_frame,
    build_scale_bar,
    build_wand,
    default_l_frame,
    default_scale_bar,
    default_wand,
)
from twin.scenes.world import Box

DURATION_S = 1.5
BOX = Box(np.array([0.5, -0.25, 1.25]), np.array([2.5, 2.4, 2.5]))
COMMON: dict[str, Any] = {"duration_s": DURATION_S, "box_center_m": BOX.center, "box_size_m": BOX.size}
TIMES = np.linspace(-0.1, DURATION_S + 0.1, 40)
CHARUCO = Board(7, 5, 0.06, 0.03, 0.045, "DICT_5X5_50")
BALL_BAR = ScaleBar(0.9, 1e-5, (BallTarget(0.02), BallTarget(0.02)))
ROUND_BAR = ScaleBar(0.9, 1e-5, (RoundTarget(0.02), RoundTarget(0.02)))


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


BUILDERS: dict[str, Callable[[int], Scene]] = {
    "tower": lambda s: build_field(**COMMON, rng=_rng(s)),
    "corner": lambda s: build_field(**COMMON, layout="corner", n=60, turn_rad_s=0.5, rng=_rng(s)),
    "board": lambda s: build_board(**COMMON, rng=_rng(s)),
    "charuco": lambda s: build_board(**COMMON, board=CHARUCO, facing=(0.0, 1.0, 0.2), rng=_rng(s)),
    "wand": lambda s: build_wand(**COMMON, rng=_rng(s)),
    "coded_bar": lambda s: build_scale_bar(**COMMON, rng=_rng(s)),
    "ball_bar": lambda s: build_scale_bar(**COMMON, bar=BALL_BAR, rng=_rng(s)),
    "round_bar": lambda s: build_scale_bar(**COMMON, bar=ROUND_BAR, rng=_rng(s)),
    "l_frame": lambda s: build_l_frame(**COMMON, azimuth_rad=0.1 * s),
    "light": lambda s: build_light_marker(**COMMON, rng=_rng(s)),
}
STANDING = {"tower", "l_frame"}


def positions(scene: Scene, times: np.ndarray = TIMES) -> np.ndarray:
    sampler = scene.sampler()
    return np.stack([sampler.at(t).marker_xyz for t in times])


@pytest.mark.parametrize("name", sorted(BUILDERS))
def test_motion_is_smooth(name: str) -> None:
    sampler, e = BUILDERS[name](7).sampler(), 1e-4
    for t in TIMES:
        before, here, after = (sampler.at(u).marker_xyz for u in (t - e, t, t + e))
        acceleration = np.abs(after - 2 * here + before).max() / e**2
        assert acceleration < (1e-6 if name in STANDING else 40.0)


@pytest.mark.parametrize("name", ["board", "charuco", "wand", "coded_bar", "light"])
def test_a_hand_keeps_its_speed_and_its_band(name: str) -> None:
    path = BUILDERS[name](3).configuration_at
    assert isinstance(path, CarriedPath)
    wanted = {"board": 0.2, "charuco": 0.2, "wand": 0.8, "coded_bar": 0.4, "light": 0.3}[name]
    step = 0.05
    place = np.array([path(t)[:3] for t in np.arange(0, 300, step)])
    measured = np.sqrt(np.mean(np.sum((np.diff(place, axis=0) / step) ** 2, axis=1)))
    assert measured == pytest.approx(wanted, rel=0.03)
    window = np.blackman(len(place))[:, None]
    power = (np.abs(np.fft.rfft((place - place.mean(axis=0)) * window, axis=0)) ** 2).sum(axis=1)
    frequency = np.fft.rfftfreq(len(place), step)
    assert power[frequency > path.highest_hz + 0.03].sum() < 1e-6 * power.sum()
    reach = np.abs(place - BOX.center).max(axis=0)
    room = np.abs(path.swing).sum(axis=0)
    assert (reach <= room * (1 + 1e-12)).all()
    assert (reach > 0.8 * room).all()


def test_a_board_faces_where_it_is_told_to() -> None:
    scene = build_board(**COMMON, facing=(0.0, -2.0, 0.0), tilt_rad=0.5, rng=_rng(1))
    normals = np.array([body_pose(scene, t)[1][:, 2] for t in np.linspace(0, 100, 1000)])
    lean = np.arccos(normals @ [0, -1, 0])
    assert lean.max() <= 0.5
    assert lean.max() > 0.3
    around = build_board(**COMMON, turn_rad_s=0.5, rng=_rng(1))
    normals = np.array([body_pose(around, t)[1][:, 2] for t in np.linspace(0, 4 * np.pi, 200)])
    assert (np.sign(normals[:, :2]).min(axis=0) < 0).all()
    assert (np.sign(normals[:, :2]).max(axis=0) > 0).all()


@pytest.mark.parametrize("layout", ["tower", "corner"])
@pytest.mark.parametrize("n", [60, 200])
def test_a_field_is_where_its_vocabulary_has_it(layout: Any, n: int) -> None:
    laid = lay_out_field(BOX.size, _rng(5), n=n, layout=layout)
    scene = build_field(**COMMON, n=n, layout=layout, rng=_rng(5))
    assert scene.marker_names == laid.field.names
    assert len(laid.field.targets) == n
    state = scene.sampler().at(0.7)
    np.testing.assert_allclose(state.marker_xyz, BOX.center + laid.field.positions, atol=1e-14)
    rotations = state.geom_rotation[list(scene.marker_geoms)]
    for rotation, placed in zip(rotations, laid.field.targets, strict=True):
        np.testing.assert_allclose(rotation, placed.rotation, atol=1e-12)
    spread = np.ptp(laid.field.positions, axis=0) / BOX.size
    assert (spread > 0.6).all()


def _sights(layout: str, rotation: np.ndarray) -> np.ndarray:
    """Directions of view (6, 3): 2 degrees off the normal (steps rise beside); for the corner, the open."""
    angle = np.arange(0, 2 * np.pi, np.pi / 3)
    off = np.deg2rad(2 if layout == "tower" else 30)
    axis = rotation if layout == "tower" else face_axes(np.ones(3))
    side = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.sin(off)
    return np.column_stack([side, np.full(6, np.cos(off))]) @ axis.T


@pytest.mark.parametrize("layout", ["tower", "corner"])
def test_nothing_hides_the_targets_of_a_field_from_nearby(layout: Any) -> None:
    """From 10 cm before each target's dot and each corner of its plate."""
    laid = lay_out_field(BOX.size, _rng(5), n=120, layout=layout)
    scene = build_field(**COMMON, n=120, layout=layout, rng=_rng(5))
    sampler = scene.sampler()
    sampler.at(0.0)
    found = np.zeros(1, dtype=np.int32)
    for geom, placed in zip(scene.marker_geoms, laid.field.targets, strict=True):
        assert isinstance(placed.target, CodedTarget)
        half = 0.499 * placed.target.plate_m
        for x, y in ((0, 0), (half, half), (-half, half), (-half, -half), (half, -half)):
            at = BOX.center + placed.position + placed.rotation @ [x, y, 0]
            for out in _sights(layout, placed.rotation):
                eye = at + 0.1 * out
                distance = mujoco.mj_ray(scene.model, sampler.data, eye, -out, None, 1, -1, found, None)
                assert found[0] == geom
                assert distance == pytest.approx(0.1, abs=1e-5)


def test_plates_lie_apart() -> None:
    laid = lay_out_field(BOX.size, _rng(5), n=200)
    xyz = laid.field.positions
    distances = np.linalg.norm(xyz[:, None] - xyz, axis=-1)[np.triu_indices(200, 1)]
    target = laid.field.targets[0].target
    assert isinstance(target, CodedTarget)
    assert distances.min() > target.plate_m  # plates on one face are even farther: the ray test above
    numbers = {p.target.number for p in laid.field.targets if isinstance(p.target, CodedTarget)}
    assert len(numbers) == 200


def test_a_field_from_a_file_stands_in_the_middle(tmp_path: Path) -> None:
    laid = lay_out_field(np.array([1.0, 0.8, 0.6]), _rng(2), n=40)
    path = tmp_path / "field.toml"
    path.write_text(target_toml(laid.field))
    scene = build_field(**COMMON, target_file=path, turn_rad_s=0.3, rng=_rng(1))
    assert scene.marker_names == laid.field.names
    place, rotation = body_pose(scene, 0.9)
    state = scene.sampler().at(0.9)
    local = (state.marker_xyz - place) @ rotation
    shift = laid.field.positions - local
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-12)
    middle = (local.max(axis=0) + local.min(axis=0)) / 2
    np.testing.assert_allclose(middle, 0, atol=1e-12)
    np.testing.assert_allclose(place, BOX.center)


def test_a_turning_field_stays_inside_whole() -> None:
    for layout in ("tower", "corner"):
        scene = build_field(**COMMON, layout=layout, turn_rad_s=1.0, rng=_rng(3))
        xyz = positions(scene, np.linspace(0, 7, 60))
        # configurations are rounded to 1e-12
        assert (xyz >= BOX.low - 1e-11).all()
        assert (xyz <= BOX.high + 1e-11).all()


def test_corners_of_a_board_move_with_it() -> None:
    scene = BUILDERS["charuco"](2)
    sampler = scene.sampler()
    place, rotation = body_pose(scene, 0.4)
    (geom,) = scene.marker_geoms
    state = sampler.at(0.4)
    np.testing.assert_allclose(state.geom_xyz[geom], place, atol=1e-14)
    np.testing.assert_allclose(state.geom_rotation[geom], rotation, atol=1e-14)
    width, height = CHARUCO.size_m
    np.testing.assert_allclose(scene.model.geom_size[geom][:2], [width / 2, height / 2])
    for t in TIMES:
        place, rotation = body_pose(scene, t)
        corners = place + CHARUCO.corners() @ rotation.T
        assert (corners >= BOX.low).all()
        assert (corners <= BOX.high).all()
    wanted = board_figure(CHARUCO, 0.04).pieces
    np.testing.assert_array_equal(scene.figures["board"].pieces, wanted)


def test_wands_bars_and_frames_have_their_lengths() -> None:
    wand = Wand((0.0, 0.13, 0.5), 0.016)
    xyz = positions(build_wand(**COMMON, wand=wand, rng=_rng(1)))[7]
    np.testing.assert_allclose(np.linalg.norm(xyz[:, None] - xyz, axis=-1), wand.distances(), atol=1e-12)
    for bar in (BALL_BAR, ROUND_BAR, ScaleBar(0.7, 0.0, (CodedTarget.of_dot(8, 0.01), CodedTarget.of_dot(9, 0.01)))):
        scene = build_scale_bar(**COMMON, bar=bar, rng=_rng(1))
        assert scene.marker_names == bar.names
        xyz = positions(scene)
        np.testing.assert_allclose(np.linalg.norm(xyz[:, 0] - xyz[:, 1], axis=1), bar.length_m, atol=1e-12)
    frame = LFrame(("o", "p", "q"), np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.3, 0.0]]), 0.02)
    scene = build_l_frame(**COMMON, l_frame=frame, azimuth_rad=0.3)
    assert scene.marker_names == ("l_frame/o", "l_frame/p", "l_frame/q")
    place, rotation = body_pose(scene, 0.0)
    np.testing.assert_allclose(positions(scene)[0], place + frame.positions @ rotation.T, atol=1e-12)
    np.testing.assert_allclose(rotation[:, 0], [np.cos(0.3), np.sin(0.3), 0], atol=1e-12)
    bars = scene.model.geom_group != MARKER_GROUP
    state = scene.sampler().at(0.0)
    lowest = min(
        z - r for z, r in zip(state.geom_xyz[bars, 2], scene.model.geom_size[bars, 0], strict=True) if r > 0.005
    )
    assert lowest == pytest.approx(BOX.low[2])


def test_stems_and_bars_leave_the_balls_in_sight() -> None:
    """From the front, up to 60 degrees off, no part of a ball is hidden."""
    scene = BUILDERS["wand"](7)
    sampler = scene.sampler()
    state = sampler.at(0.2)
    _, rotation = body_pose(scene, 0.2)
    found = np.zeros(1, dtype=np.int32)
    for geom, centre in zip(scene.marker_geoms, state.marker_xyz, strict=True):
        radius = scene.model.geom_size[geom, 0]
        for off in np.deg2rad([0, 30, 60]):
            for angle in np.arange(0, 2 * np.pi, np.pi / 4):
                out = rotation @ [np.sin(off) * np.cos(angle), np.sin(off) * np.sin(angle), np.cos(off)]
                across = np.cross(out, rotation[:, 1])
                for share in (-0.95, 0.0, 0.95):
                    eye = centre + 0.1 * out + share * radius * across / np.linalg.norm(across)
                    mujoco.mj_ray(scene.model, sampler.data, eye, -out, None, 1, -1, found, None)
                    assert found[0] == geom


def test_materials() -> None:
    printed = build_field(**COMMON, n=10, glow=PAPER, rng=_rng(1))
    assert set(printed.glows.values()) == {PAPER}
    taped = build_field(**COMMON, n=10, rng=_rng(1))
    assert set(taped.glows.values()) == {RETRO}
    for name in taped.marker_names:  # black tape sends nothing; printed black is a grey plate behind
        assert taped.figures[name].radius < printed.figures[name].radius


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: build_field(**COMMON, n=3, rng=_rng(1)), "n = 3 given; 4 to 507"),
        (lambda: build_field(**COMMON, n=508, rng=_rng(1)), "n = 508 given"),
        (lambda: build_field(**COMMON, layout="wall", rng=_rng(1)), "layout = 'wall' given; allowed: tower"),  # type: ignore[arg-type]
        (lambda: build_field(**COMMON, dot_radius_m=0.1, rng=_rng(1)), "leave room for dots of 0.0"),
        (lambda: build_field(**COMMON, turn_rad_s=float("nan"), rng=_rng(1)), "turn_rad_s = nan given"),
        (lambda: build_board(**COMMON, board=Board(9, 6, 0.3, 0.1), rng=_rng(1)), "too small for this board"),
        (lambda: build_board(**COMMON, facing=(0.0, 0.0, 0.0), rng=_rng(1)), "facing = "),
        (lambda: build_board(**COMMON, tilt_rad=2.0, rng=_rng(1)), "tilt_rad = 2 given"),
        (lambda: build_board(**COMMON, speed_mps=0.0, rng=_rng(1)), "speed_mps = 0.0 given"),
        (lambda: build_wand(**COMMON, wand=Wand((0.0, 2.5), 0.02), rng=_rng(1)), "too small for this wand"),
        (
            lambda: build_scale_bar(**COMMON, bar=ScaleBar(2.5, 0.0, (BallTarget(0.02),) * 2), rng=_rng(1)),
            "too small for this scale bar",
        ),
        (
            lambda: build_l_frame(
                **COMMON, l_frame=LFrame(("a", "b", "c"), np.diag([4.0, 2.0, 1.0]), 0.02), azimuth_rad=0.0
            ),
            "too small for this L-frame",
        ),
    ],
)
def test_what_does_not_fit_is_said(make: Callable[[], Scene], said: str) -> None:
    with pytest.raises(InputError) as error:
        make()
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_do_not_fit_are_named(tmp_path: Path) -> None:
    path = tmp_path / "wand.toml"
    path.write_text('kind = "wand"\nalong_m = [0, 0.5]\ndiameter_m = 0.02\n')
    with pytest.raises(InputError, match=r'wand\.toml: a test field is wanted; set kind = "field"'):
        build_field(**COMMON, target_file=path, rng=_rng(1))
    big = lay_out_field(np.array([4.0, 1.0, 1.0]), _rng(2), n=40)
    path.write_text(target_toml(big.field))
    with pytest.raises(InputError, match=r"wand\.toml: the field takes .* enlarge box_size_m"):
        build_field(**COMMON, target_file=path, rng=_rng(1))


@pytest.mark.parametrize("edge", [0.1, 1.0, 10.0])
def test_default_targets_scale_with_the_working_space(edge: float) -> None:
    box = Box(np.zeros(3), np.full(3, edge))
    common: dict[str, Any] = {"duration_s": 1.0, "box_center_m": box.center, "box_size_m": box.size}
    assert default_wand(box).along_m[-1] == pytest.approx(edge / 3)
    assert default_scale_bar(box).length_m == pytest.approx(edge / 3)
    assert np.ptp(default_l_frame(box).positions) == pytest.approx(edge / 3)
    assert default_board(box).size_m[0] == pytest.approx(0.35 * edge)
    for build in (build_field, build_board, build_wand, build_scale_bar, build_light_marker):
        assert build(**common, rng=_rng(1)).marker_names
    assert build_l_frame(**common).marker_names


def test_a_scene_refuses_figures_and_glows_of_nobody() -> None:
    scene = BUILDERS["wand"](1)
    parts: dict[str, Any] = {
        "model": scene.model,
        "marker_names": scene.marker_names,
        "marker_geoms": scene.marker_geoms,
        "configuration_at": scene.configuration_at,
        "duration_s": 1.0,
    }
    shape = board_figure(CHARUCO)
    with pytest.raises(ValueError, match="glow of 'none': the scene has no such marker"):
        Scene(**parts, glows={"none": Glow()})
    with pytest.raises(ValueError, match="figure of 'none'"):
        Scene(**parts, figures={"none": shape})
    with pytest.raises(ValueError, match="marker 'wand/1' is a ball"):
        Scene(**parts, figures={"wand/1": shape})
    board = BUILDERS["board"](1)
    parts |= {"model": board.model, "marker_names": board.marker_names, "marker_geoms": board.marker_geoms}
    with pytest.raises(ValueError, match="marker 'board' is a plate without a figure"):
        Scene(**parts)
