"""A user's own model: markers seated on meshes and primitives, three ways to move, errors that help."""

import contextlib
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosca.errors import InputError
from twin.scenes.scene import UNSEEN_GROUP, Scene
from twin.scenes.user_markers import MarkersInModel, read_marker_table
from twin.scenes.user_model import build_own
from twin.scenes.world import FLAT_HALF_THICKNESS_M, SEAT_M

URDF = """<robot name="r">
<link name="base"><inertial><mass value="1"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0 0 0.1"/><geometry><mesh filename="meshes/block.stl"/></geometry></visual>
<collision><geometry><box size=".9 .9 .9"/></geometry></collision></link>
<link name="arm"><inertial><mass value="1"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><cylinder radius=".03" length=".3"/></geometry></visual></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 .5"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
MJCF = """<mujoco><worldbody><body name="ball" pos="0 0 0.5"><freejoint/><geom type="sphere" size=".1"/>
<geom type="box" size=".3 .3 .3" group="3" contype="0" conaffinity="0" mass="0"/></body></worldbody></mujoco>"""
CENTER, SIZE = np.array([0.0, 0.0, 1.25]), np.array([2.5, 2.5, 2.5])


def _own(folder: Path, model: str, markers: str, **settings: Any) -> Scene:
    name = "model.urdf" if "<robot" in model else "model.xml"
    (folder / name).write_text(model)
    (folder / "markers.csv").write_text(markers)
    given = {
        "duration_s": 0.4,
        "box_center_m": CENTER,
        "box_size_m": SIZE,
        "rng": np.random.default_rng(0),
        "model_file": folder / name,
        "markers_file": folder / "markers.csv",
    }
    return build_own(**{**given, **settings})


def _with_mesh(folder: Path) -> Path:
    (folder / "meshes").mkdir(exist_ok=True)
    trimesh.creation.box(extents=[0.4, 0.2, 0.1]).export(folder / "meshes" / "block.stl")
    return folder


def test_markers_sit_on_the_mesh_and_collision_shapes_do_not_count(tmp_path: Path) -> None:
    markers = "name,body,x,y,z,diameter,kind\nA,base,.01,.02,.5,.02,\nB,base,.19,0,.12,,flat\nC,base,.2,.1,.15,,\n"
    scene = _own(_with_mesh(tmp_path), URDF, markers, motion="physics", floor=False)
    state = scene.sampler().at(0.0)
    # The block is 0.4 x 0.2 x 0.1 about (0, 0, 0.1): top at 0.15, side at x = 0.2, a corner at C.
    np.testing.assert_allclose(state.marker_xyz[0], [0.01, 0.02, 0.15 + SEAT_M + 0.01], atol=1e-7)
    np.testing.assert_allclose(state.marker_xyz[1], [0.2 + FLAT_HALF_THICKNESS_M, 0, 0.12], atol=1e-7)
    np.testing.assert_allclose(state.marker_axis[1], [1, 0, 0], atol=1e-7)
    away = state.marker_xyz[2] - [0.2, 0.1, 0.15]
    assert np.linalg.norm(away) == pytest.approx(SEAT_M + 0.008, abs=1e-7)
    assert (away > 0.003).all()  # off the corner, along the mean of its three faces
    assert scene.bodies == {"base": ("A", "B", "C")}
    boxes = scene.model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    assert set(scene.model.geom_group[boxes]) == {UNSEEN_GROUP}
    assert (scene.model.geom_type == mujoco.mjtGeom.mjGEOM_MESH).sum() == 1


PRIMITIVES = [
    ('type="sphere" size=".1"', [0.3, 0.4, 0.0], [0.06, 0.08, 0.0], [0.6, 0.8, 0.0]),
    ('type="box" size=".1 .2 .3"', [0.05, 0.05, 0.9], [0.05, 0.05, 0.3], [0, 0, 1]),
    ('type="cylinder" size=".1 .3"', [0.5, 0.0, 0.1], [0.1, 0.0, 0.1], [1, 0, 0]),
    ('type="capsule" size=".1 .3"', [0.0, 0.0, 0.9], [0.0, 0.0, 0.4], [0, 0, 1]),
    ('type="ellipsoid" size=".1 .2 .3"', [0.0, -0.6, 0.0], [0.0, -0.2, 0.0], [0, -1, 0]),
    ('type="box" size=".1 .2 .3" pos="1 0 0" euler="0 0 90"', [1.5, 0, 0], [1.2, 0, 0], [1, 0, 0]),
]


@pytest.mark.parametrize(("geom", "near", "surface", "normal"), PRIMITIVES)
def test_markers_are_seated_on_primitives(
    tmp_path: Path, geom: str, near: list[float], surface: list[float], normal: list[float]
) -> None:
    """By hand; the faceted round shapes are 0.1 mm too low and 2 mm off along the surface at most."""
    model = f'<mujoco><worldbody><body name="b"><freejoint/><geom {geom}/></body></worldbody></mujoco>'
    row = ",".join(map(str, near))
    scene = _own(tmp_path, model, f"name,body,x,y,z,diameter\nA,b,{row},0.01\n", motion="physics", floor=False)
    placed = scene.model.geom_pos[scene.marker_geoms[0]]
    wanted = np.array(surface) + (SEAT_M + 0.005) * np.array(normal)
    np.testing.assert_allclose(placed, wanted, atol=2e-3)
    assert placed @ np.array(normal) == pytest.approx(wanted @ np.array(normal), abs=1e-4)


def test_physics_is_free_fall(tmp_path: Path) -> None:
    scene = _own(tmp_path, MJCF, "name,body,x,y,z\nA,ball,0,0,1\n", motion="physics", floor=False)
    for t in (-0.1, 0.0, 0.1234, 0.4):
        fallen = 9.81 * (t + 0.1) ** 2 / 2
        # MuJoCo's Euler steps of 2 ms lag the parabola by g t h / 2.
        assert scene.configuration_at(t)[2] == pytest.approx(0.5 - fallen, abs=0.006)


def test_a_table_of_configurations_is_played(tmp_path: Path) -> None:
    times = np.linspace(0, 1, 41)
    half = times / 2  # 1 rad/s about z
    rows = [f"{t},{np.sin(t)},0,0.5,{np.cos(h)},0,0,{np.sin(h)}" for t, h in zip(times, half, strict=True)]
    (tmp_path / "q.csv").write_text("time,x,y,z,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    markers = "name,body,x,y,z\nA,ball,1,0,0\n"
    scene = _own(tmp_path, MJCF, markers, motion="table", motion_file=tmp_path / "q.csv", duration_s=1.0, floor=False)
    sampler, reach = scene.sampler(), 0.1 + SEAT_M + 0.008
    for t in (0.0, 0.317, 0.9):
        wanted = [np.sin(t) + reach * np.cos(t), reach * np.sin(t), 0.5]
        np.testing.assert_allclose(sampler.at(t).marker_xyz[0], wanted, atol=2e-4)


def test_a_turntable_carries_the_whole_model_about_the_box(tmp_path: Path) -> None:
    markers = "name,body,x,y,z\nA,base,0.1,0.02,0.5\nB,arm,1,0,0\n"
    scene = _own(_with_mesh(tmp_path), URDF, markers, duration_s=20.0)
    sampler = scene.sampler()
    xyz = np.stack([sampler.at(t).marker_xyz for t in np.linspace(0, 20, 300)])
    assert (np.abs(xyz - CENTER) < SIZE / 2).all()
    assert np.ptp(xyz[:, 0], axis=0).min() > 0.5
    assert np.ptp(np.linalg.norm(xyz[:, 0] - xyz[:, 1], axis=1)) < 1e-12
    turned = np.unwrap([2 * np.arctan2(q[6], q[3]) for q in map(scene.configuration_at, np.linspace(0, 5, 200))])
    assert abs(turned[-1] - turned[0]) == pytest.approx(5.0, abs=0.3)


@pytest.mark.parametrize(
    ("model", "markers", "settings", "said"),
    [
        ("<mujoco><worldbody>", "name,body,x,y,z\nA,b,0,0,0\n", {}, "MuJoCo cannot load it"),
        (URDF, "name,body,x,y,z\nA,base,0,0,0\n", {}, "cannot load it.*block.stl"),
        (MJCF, "name,body,x,y,z\nA,bell,0,0,0\n", {}, "body 'bell' given; bodies with a surface: ball"),
        (MJCF, "name,body,x,y\nA,ball,0,0\n", {}, "row 2: key 'z' is missing"),
        (MJCF, "name,body,x,y,z\nA,ball,0,0,nil\n", {}, "row 2: key 'z': 'nil' given"),
        (MJCF, "name,body,x,y,z\nA,ball,0,0\n", {}, "row 2 has not as many cells"),
        (MJCF, "name,body,x,y,z\nA,ball,0,0,1\nA,ball,1,0,0\n", {}, "'A' is used twice"),
        (MJCF, "name,body,x,y,z\n", {}, "no markers"),
        (MJCF, "name,body,x,y,z\nA,ball,0,0,1\n", {"motion": "table"}, "motion_file goes with 'table'"),
        (MJCF, "name,body,x,y,z\nA,ball,0,0,1\n", {"motion": "fly"}, "motion is one of turntable, physics, table"),
        (MJCF, "name,body,x,y,z\nA,ball,0,0,1\n", {"box_size_m": np.full(3, 0.15)}, "too small for this model"),
    ],
)
def test_errors_say_what_to_do(tmp_path: Path, model: str, markers: str, settings: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        _own(tmp_path, model, markers, **settings)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("time,q\n0,1\n1,2\n", "time and 7 numbers of qpos"),
        ("time,q\n0,1,2,3,1,0,0,0\n0,1,2,3,1,0,0,0\n", "times must rise"),
        ("time,q\n0,1,2,3,1,0,0,0\n0.1,1,2,3,1,0,0,0\n", "must be covered"),
        ("time,q\n0,1,2,3,0,0,0,0\n1,1,2,3,1,0,0,0\n", "a quaternion"),
        ("time,q\n0,1,2,x,0,0,0,0\n1,1,2,3,1,0,0,0\n", "rows of 8 numbers"),
    ],
)
def test_tables_that_do_not_fit(tmp_path: Path, table: str, said: str) -> None:
    (tmp_path / "q.csv").write_text(table)
    with pytest.raises(InputError, match=said):
        _own(tmp_path, MJCF, "name,body,x,y,z\nA,ball,0,0,1\n", motion="table", motion_file=tmp_path / "q.csv")


def test_markers_may_stand_in_a_toml_file(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text('[[marker]]\nname = "A"\nbody = "ball"\nx = 0\ny = 0.0\nz = 1.0\n')
    (marker,) = read_marker_table(tmp_path / "m.toml")
    assert (marker.name, marker.z, marker.diameter, marker.kind) == ("A", 1.0, 0.016, "ball")
    (tmp_path / "m.toml").write_text('[[marker]]\nname = "A"\nbodi = "ball"\nx = 0\ny = 0.0\nz = 1.0\n')
    with pytest.raises(InputError, match="did you mean"):
        read_marker_table(tmp_path / "m.toml")


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(content=st.one_of(st.binary(max_size=120), st.text('name,body,xyz0.1\n"A', max_size=60).map(str.encode)))
@pytest.mark.parametrize("suffix", [".csv", ".toml"])
def test_any_bytes_as_a_marker_table(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"m{suffix}"
    path.write_bytes(content)
    with contextlib.suppress(InputError):
        assert read_marker_table(path)


def test_diverging_physics_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log into the working folder
    model = MJCF.replace("<worldbody>", '<option timestep="0.01" gravity="0 0 -1e12"/><worldbody>')
    with pytest.raises(InputError, match="the physics diverges"):
        _own(tmp_path, model, "name,body,x,y,z\nA,ball,0,0,1\n", motion="physics")


SITES = """<mujoco><worldbody><body name="cart"><freejoint/><geom type="box" size=".2 .1 .05"/>
<frame pos="0 0 .01"><site name="mk_top" pos=".1 0 .06" size=".01"/></frame><site name="mk_side" pos="0 .12 0"/>
<site name="grip" pos="0 0 .05"/><geom name="ball_1" type="sphere" size=".008" pos=".15 .05 .08"/>
<geom name="ball_2" type="sphere" size=".012" pos="-.15 0 .09"/></body></worldbody></mujoco>"""


def _in_model(folder: Path, words: str, model: str = SITES) -> Scene:
    marked = MarkersInModel.of_words(words)
    assert marked is not None
    return _own(folder, model, "", markers_file=marked, motion="physics", floor=False)


def test_a_models_own_sites_are_seated_with_their_sizes(tmp_path: Path) -> None:
    scene = _in_model(tmp_path, "sites:mk_*")
    assert scene.marker_names == ("mk_top", "mk_side")
    center = scene.model.geom_pos[list(scene.marker_geoms)]
    # on the box's top and side, each off by its radius and its base; a site's default radius is 5 mm
    assert center == pytest.approx(np.array([[0.1, 0, 0.05 + 0.01 + SEAT_M], [0, 0.1 + 0.005 + SEAT_M, 0]]), abs=1e-9)
    assert scene.model.geom_size[list(scene.marker_geoms), 0] == pytest.approx([0.01, 0.005])
    assert _in_model(tmp_path, "sites").marker_names == ("mk_top", "mk_side", "grip")


def test_a_models_own_spheres_become_markers_where_they_are(tmp_path: Path) -> None:
    scene = _in_model(tmp_path, "geoms:ball_?")
    assert scene.marker_names == ("ball_1", "ball_2")
    found = list(scene.marker_geoms)
    assert scene.model.geom_pos[found] == pytest.approx(np.array([[0.15, 0.05, 0.08], [-0.15, 0, 0.09]]))
    assert scene.model.geom_size[found, 0] == pytest.approx([0.008, 0.012])
    # the sphere itself is not seen besides, and hides nothing
    assert {int(scene.model.geom(name).group[0]) for name in ("ball_1", "ball_2")} == {UNSEEN_GROUP}


@pytest.mark.parametrize(
    ("words", "model", "told"),
    [
        (
            "sites:x*",
            SITES,
            "markers 'sites:x*' given; named sites in the model: mk_top, mk_side, grip; give a pattern",
        ),
        ("geoms", re.sub("<geom name=.*?/>", "", SITES), "named spheres in the model: none; give a pattern"),
        ("sites", SITES.replace(' name="cart"', ""), "marker 'mk_top' is on a body without a name; name the body"),
        ("sites", SITES.replace('size=".01"', 'size="2"'), "'mk_top': key 'diameter'"),
    ],
)
def test_a_models_own_markers_that_are_none(tmp_path: Path, words: str, model: str, told: str) -> None:
    with pytest.raises(InputError) as error:
        _in_model(tmp_path, words, model)
    assert told in str(error.value)
    assert "model.xml" in str(error.value)


def test_words_that_are_a_tables_path() -> None:
    assert [MarkersInModel.of_words(words) for words in ("markers.csv", "sites.csv", "geoms/a.toml", "")] == [
        None
    ] * 4
