"""What every scene promises: pure functions of time, smooth motion, rigid bodies, markers that are markers."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from test_targets_scenes import BUILDERS as TARGETS
from test_targets_scenes import positions

from twin.scenes.actor import build_actor
from twin.scenes.cloud import build_cloud
from twin.scenes.drone import build_drone
from twin.scenes.face import build_face
from twin.scenes.robot import build_robot
from twin.scenes.scene import MARKER_GROUP, Scene
from twin.scenes.user_model import OwnMotion, build_own
from twin.scenes.world import MARKER_PREFIX

DURATION_S = 1.5
BOX_CENTER_M, BOX_SIZE_M = np.array([0.5, -0.25, 1.25]), np.array([2.5, 2.4, 2.5])

OWN_MODEL = """<mujoco><worldbody><body name="base" pos="0 0 1"><freejoint/>
<geom type="box" size=".2 .1 .05"/><body name="arm" pos="0 0 .1"><joint type="ball" name="neck"/>
<geom type="capsule" fromto="0 0 0 0 0 .3" size=".04"/></body></body></worldbody></mujoco>"""
OWN_MARKERS = """name,body,x,y,z,diameter,kind
A,base,.2,.1,.05,,
B,base,-.2,.1,0,,
C,base,0,0,.06,,flat
D,arm,0,0,.4,,
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("own")
    (place / "model.xml").write_text(OWN_MODEL)
    (place / "markers.csv").write_text(OWN_MARKERS)
    return place


Builder = Callable[[int, Path], Scene]
COMMON: dict[str, Any] = {"duration_s": DURATION_S, "box_center_m": BOX_CENTER_M, "box_size_m": BOX_SIZE_M}


def _own(seed: int, folder: Path, motion: OwnMotion) -> Scene:
    files: dict[str, Any] = {"model_file": folder / "model.xml", "markers_file": folder / "markers.csv"}
    return build_own(**COMMON, **files, motion=motion, rng=np.random.default_rng(seed))


BUILDERS: dict[str, Builder] = {
    "circle": lambda s, _: build_actor(**COMMON, rng=np.random.default_rng(s)),
    "in_place": lambda s, _: build_actor(**COMMON, gait="in_place", rng=np.random.default_rng(s)),
    "back_and_forth": lambda s, _: build_actor(**COMMON, gait="back_and_forth", rng=np.random.default_rng(s)),
    "drone": lambda s, _: build_drone(**COMMON, rng=np.random.default_rng(s)).scene,
    "robot": lambda s, _: build_robot(**COMMON, rng=np.random.default_rng(s)),
    "face": lambda s, _: build_face(**COMMON, rng=np.random.default_rng(s)),
    "cloud": lambda s, _: build_cloud(**COMMON, rng=np.random.default_rng(s)),
    "turntable": lambda s, f: _own(s, f, "turntable"),
    "physics": lambda s, f: _own(s, f, "physics"),
    **{name: lambda s, _, build=build: build(s) for name, build in TARGETS.items()},
}


@pytest.fixture(scope="module", params=sorted(BUILDERS))
def made(request: pytest.FixtureRequest, folder: Path) -> tuple[str, Scene]:
    return request.param, BUILDERS[request.param](7, folder)


def test_markers_are_massless_geoms_that_touch_nothing(made: tuple[str, Scene]) -> None:
    name, scene = made
    model, ids = scene.model, np.array(scene.marker_geoms)
    assert len(set(scene.marker_names)) == len(ids)
    assert [model.geom(int(g)).name.rpartition(MARKER_PREFIX)[2] for g in ids] == list(scene.marker_names)
    assert set(np.nonzero(model.geom_group == MARKER_GROUP)[0]) == set(ids)
    assert not model.geom_contype[ids].any()
    assert not model.geom_conaffinity[ids].any()
    sphere, cylinder, box = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{k}")) for k in ("SPHERE", "CYLINDER", "BOX"))
    assert set(model.geom_type[ids]) <= {sphere, cylinder, box}
    boxes = model.geom_type[ids] == box
    assert {n for n, is_box in zip(scene.marker_names, boxes, strict=True) if is_box} == set(scene.figures)
    assert model.nmocap == 0
    for names in scene.bodies.values():
        assert set(names) <= set(scene.marker_names)
    if name in TARGETS:
        assert set(scene.glows) == set(scene.marker_names)
        assert list(scene.bodies.values()) == [scene.marker_names]


def test_same_seed_gives_the_same_bytes(made: tuple[str, Scene], folder: Path) -> None:
    name, scene = made
    again, other = BUILDERS[name](7, folder), BUILDERS[name](8, folder)
    times = np.linspace(-0.1, DURATION_S + 0.1, 23)
    for t in times:
        assert scene.configuration_at(t).tobytes() == again.configuration_at(t).tobytes()
    assert positions(scene, times).tobytes() == positions(again, times).tobytes()
    if name != "physics" and scene.marker_names == other.marker_names:  # nothing is drawn there
        assert (positions(scene, times) != positions(other, times)).any()


def test_configurations_are_pure_and_may_be_asked_for_from_any_thread(made: tuple[str, Scene]) -> None:
    _, scene = made
    times = np.linspace(-0.1, DURATION_S + 0.1, 101)

    def walk(order: np.ndarray) -> bytes:
        sampler, found = scene.sampler(), {}
        for t in order:
            found[t] = scene.configuration_at(t).tobytes() + sampler.at(t).marker_xyz.tobytes()
        return b"".join(found[t] for t in times)

    orders = [times, times[::-1], np.roll(times, 37), np.roll(times[::-1], 11)]
    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(walk, orders))) == 1


def test_what_a_caller_does_to_a_configuration_does_not_stay(made: tuple[str, Scene]) -> None:
    _, scene = made
    before = scene.configuration_at(0.3).copy()
    scene.configuration_at(0.3)[:] = 99.0
    np.testing.assert_array_equal(scene.configuration_at(0.3), before)


def test_quaternions_are_unit_and_everything_is_finite(made: tuple[str, Scene]) -> None:
    _, scene = made
    model = scene.model
    for t in np.linspace(-0.1, DURATION_S + 0.1, 31):
        qpos = scene.configuration_at(t)
        assert np.isfinite(qpos).all()
        normal = qpos.copy()
        mujoco.mj_normalizeQuat(model, normal)
        np.testing.assert_allclose(qpos, normal, atol=1e-12)


def test_markers_keep_their_place_on_their_bodies(made: tuple[str, Scene]) -> None:
    _, scene = made
    sampler = scene.sampler()
    owner = scene.model.geom_bodyid[list(scene.marker_geoms)]
    xyz = np.stack([sampler.at(t).marker_xyz for t in np.linspace(-0.1, DURATION_S + 0.1, 40)])
    for body in np.unique(owner):
        mine = xyz[:, owner == body]
        distances = np.linalg.norm(mine[:, :, None] - mine[:, None], axis=-1)
        assert np.ptp(distances, axis=0).max() < 1e-12


def test_motion_has_no_corners_at_physics_steps_or_between(made: tuple[str, Scene]) -> None:
    """One-sided speeds agree: a corner of straight segments 1 ms long would differ by acceleration x 1 ms."""
    _, scene = made
    sampler, e = scene.sampler(), 1e-7
    nodes = np.round(np.linspace(0.0, DURATION_S, 61), 3)  # whole milliseconds: the physics' own steps
    for t in np.concatenate([nodes, nodes[:20] + 0.00037]):
        before, here, after = (sampler.at(u).marker_xyz for u in (t - e, t, t + e))
        jump = np.abs((after - here) / e - (here - before) / e).max()
        assert jump < 1e-4, f"speed jumps by {jump} m/s at {t} s"


def test_markers_stay_in_the_working_space(made: tuple[str, Scene]) -> None:
    name, scene = made
    if name == "physics":
        pytest.skip("a body that is let go falls where it falls")
    sampler = scene.sampler()
    xyz = np.stack([sampler.at(t).marker_xyz for t in np.linspace(-0.1, DURATION_S + 0.1, 80)])
    assert (xyz >= BOX_CENTER_M - BOX_SIZE_M / 2).all()
    assert (xyz <= BOX_CENTER_M + BOX_SIZE_M / 2).all()
    assert (xyz[..., 2] > 0).all()
