"""The face that speaks: sizes as in people, how far and how fast it moves, and what hides its markers."""

import mujoco
import numpy as np
import pytest

from mosca.errors import InputError
from twin.scenes.face import SpeakingHead, build_face
from twin.scenes.face_surface import JAW_RAD, SHAPES, BlendShapes, FaceSurface, jaw_share, markers_on_front
from twin.scenes.scene import Scene

BOX = {"box_center_m": np.array([0.1, 0.0, 1.2]), "box_size_m": np.full(3, 0.3)}
NAMES, FRONT = markers_on_front()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build_face(duration_s=4.0, **BOX, rng=np.random.default_rng(3))


def test_forty_markers_left_and_right_alike() -> None:
    assert len(set(NAMES)) == 40
    at = dict(zip(NAMES, FRONT.tolist(), strict=True))
    left = [name for name in NAMES if name.startswith("L")]
    assert all(at["R" + name[1:]] == [-at[name][0], at[name][1]] for name in left)


def test_a_blend_shape_goes_as_far_as_people_do() -> None:
    """Jaw 12 mm at 110 mm from its joint; lips protrude by 3 to 5 mm, brows rise by 8; the forehead rests."""
    face = FaceSurface(np.ones(3), np.zeros((0, 5)))
    shapes = BlendShapes.of(face, FRONT)
    index = {name: k for k, (name, _, _) in enumerate(SHAPES)}

    def moved(*names: str) -> dict[str, np.ndarray]:
        value = np.isin(np.arange(len(SHAPES)), [index[name] for name in names]).astype(float)
        return dict(zip(NAMES, 1e3 * shapes.moved(value), strict=True))

    jaw = moved("jaw")
    chin = face.placed(face.skin(FRONT))[NAMES.index("MCHN")] - face.jaw_joint
    # the chord of a circle about the joint
    assert np.linalg.norm(jaw["MCHN"]) == pytest.approx(2e3 * np.linalg.norm(chin) * np.sin(JAW_RAD / 2), rel=0.01)
    assert jaw["MCHN"][2] < -5.0
    assert jaw["MCHN"][0] < 0.0
    assert np.linalg.norm(jaw["MFHD"]) < 1e-3
    assert np.linalg.norm(jaw["MULP"]) < 1.0
    pucker = moved("pucker")
    assert pucker["MULP"][0] == pytest.approx(4.0, abs=1.5)
    assert pucker["LMTC"][1] < -4.0
    assert pucker["RMTC"][1] > 4.0
    # the last of both brows' shapes is the right one's
    assert moved("brow_raise")["RBRM"][2] == pytest.approx(8.0, abs=1.0)
    np.testing.assert_allclose(jaw_share(np.array([[0.0, -53.0], [0.0, -95.0], [0.0, 40.0]])), [0.5, 1, 0], atol=1e-4)


def test_lips_move_at_the_rate_of_syllables(scene: Scene) -> None:
    """Chandrasekaran et al. 2009: the mouth opens and closes at 2 to 7 Hz."""
    path = scene.configuration_at
    assert isinstance(path, SpeakingHead)
    times = np.arange(0, 4.0, 0.01)
    value = np.array([path.coefficients(float(t)) for t in times])
    assert value.min() >= 0.0
    assert value.max() <= 1.0
    opening = value[:, 0] - value[:, 0].mean()
    power = np.abs(np.fft.rfft(opening * np.hanning(len(opening)))) ** 2
    hz = np.fft.rfftfreq(len(opening), 0.01)
    assert power[(hz > 1.5) & (hz < 8)].sum() > 0.6 * power[hz > 0.3].sum()
    # none of it is faster than cameras of 100 Hz can follow
    assert power[hz > 20].sum() < 1e-3 * power.sum()


def test_true_positions_are_head_and_skin_together(scene: Scene) -> None:
    """Ball centres by the free joint's pose, the place at rest and the slides, without MuJoCo's kinematics."""
    path, model = scene.configuration_at, scene.model
    assert isinstance(path, SpeakingHead)
    for time in (0.0, 1.7):
        qpos = path(time)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, qpos[3:7])
        rest = model.geom_pos[list(scene.marker_geoms)]
        wanted = qpos[:3] + (rest + qpos[path.slides]) @ turn.reshape(3, 3).T
        np.testing.assert_allclose(scene.sampler().at(time).marker_xyz, wanted, atol=1e-9)


def test_a_marker_is_seen_from_before_the_skin_and_not_from_behind_it(scene: Scene) -> None:
    sampler = scene.sampler()
    geom = np.zeros(1, dtype=np.int32)
    for time in np.arange(0, 4.0, 0.5):
        state = sampler.at(float(time))
        for k, name in enumerate(scene.marker_names):
            out = sampler.data.geom(f"disc/{name}").xmat.reshape(3, 3)[:, 2]
            for side in (1.0, -1.0):
                eye = state.marker_xyz[k] + side * 0.12 * out
                mujoco.mj_ray(scene.model, sampler.data, eye, -side * out, None, 1, -1, geom)
                assert (geom[0] == scene.marker_geoms[k]) == (side > 0), name


def test_a_person_and_a_movement_are_drawn_by_the_seed() -> None:
    one, again, other = (build_face(duration_s=1.0, **BOX, rng=np.random.default_rng(s)) for s in (1, 1, 2))
    first, second, third = (s.sampler().at(0.3).marker_xyz for s in (one, again, other))
    assert (first == second).all()
    assert np.abs(first - third).max() > 1e-3


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"box_size_m": np.full(3, 0.15)}, "too small for this face as it moves"),
        ({"size": 2.0}, "size = 2 given; 0.7 to 1.3"),
        ({"marker_diameter_m": 0.0}, "marker_diameter_m = 0"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        build_face(**{"duration_s": 1.0, **BOX, "rng": np.random.default_rng(0), **changes})
