"""The drone before its test field: printed targets keep their light behind a hull that hides none of them."""

from dataclasses import replace

import numpy as np
import pytest

from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.errors import InputError
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.drone import build_drone
from twin.scenes.scene import UNSEEN_GROUP, Scene
from twin.scenes.survey_flight import FACING_DRONE, SurveyField, seen_by_drone, seen_by_rig, upright_field
from twin.source import TwinSource

AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
BOX = {"box_center_m": np.array([0.0, 0.0, 1.25]), "box_size_m": np.array([2.0, 2.0, 1.0])}


@pytest.fixture(scope="module")
def flown() -> tuple[Scene, Scene, SurveyField]:
    flight = build_drone(duration_s=0.2, rng=np.random.default_rng(1), markers=5, **BOX)
    field = upright_field((2.0, 1.3), 12, 0.2, 0.02, np.random.default_rng(2))
    there = SurveyField(field, Pose(FACING_DRONE, np.array([1.9, 0.0, 1.25])), np.array([0.0, 0.8, 0.0]), 0.04, 0.09)
    return seen_by_drone(flight, there), seen_by_rig(flight, there, flight.scene.marker_names, 0.02), there


def image(scene: Scene, exposure_s: float) -> np.ndarray:
    """The first frame of a camera before the hull's rim."""
    lens = OpenCVLens(300.0, 300.0, 199.5, 119.5)
    camera = Camera("front", 400, 240, lens, Pose(AHEAD, np.array([0.2, 0.0, 0.0])))
    virtual = VirtualCamera(camera, timing=Timing(row_time_s=45e-6), mount=Mount(body="drone"))
    words = {"frame_rate_hz": 30.0, "exposure_s": exposure_s, "pulses": 1, "seed": 1}
    with TwinSource(scene, (virtual,), **words) as source:
        shown = next(iter(source)).image
    assert shown is not None
    return shown.astype(float)


@pytest.mark.parametrize("exposure_s", [0.0005, 0.01])
def test_a_hull_near_the_camera_takes_no_light_of_targets_that_it_does_not_hide(
    flown: tuple[Scene, Scene, SurveyField], exposure_s: float
) -> None:
    scene = flown[0]
    model = scene.model
    drone = model.body("drone").id
    hull = [g for g in range(model.ngeom) if model.geom_bodyid[g] == drone]
    assert len(hull) > 50
    with_hull = image(scene, exposure_s)
    groups = model.geom_group[hull].copy()
    model.geom_group[hull] = UNSEEN_GROUP
    try:
        without = image(replace(scene), exposure_s)
    finally:
        model.geom_group[hull] = groups
    assert without.max() > 100
    # the same sensor noise: what is left is how the boundary is summed
    assert np.abs(with_hull - without).max() <= 1


def test_both_scenes_are_of_one_flight_and_the_field_stands_where_it_is_told(
    flown: tuple[Scene, Scene, SurveyField],
) -> None:
    camera, rig, there = flown
    places = []
    for scene in (camera, rig):
        sampler = scene.sampler()
        state = sampler.at(0.13)
        lamp = state.marker_xyz[scene.marker_names.index("light")]
        np.testing.assert_allclose(lamp, [1.9, 0.0, 2.05], atol=1e-9)
        places.append(sampler.data.xpos[scene.model.body("drone").id].copy())
    np.testing.assert_array_equal(*places)
    state = camera.sampler().at(0.0)
    first = there.field.targets[0]
    at = camera.marker_names.index(first.name)
    # x of the field is -y of the room, y its z, z its -x
    x, y, z = first.position
    np.testing.assert_allclose(state.marker_xyz[at], [1.9 - z, -x, 1.25 + y], atol=1e-9)
    np.testing.assert_allclose(state.marker_axis[at], [-1.0, 0.0, 0.0], atol=1e-9)
    assert rig.bodies == {"drone": ("D1", "D2", "D3", "D4", "D5")}


def test_targets_that_do_not_fit_are_told() -> None:
    with pytest.raises(InputError, match=r"dot_radius_m = 0.06: 12 targets on 2 x 1.3 m leave 0.4 m each"):
        upright_field((2.0, 1.3), 12, 0.2, 0.06, np.random.default_rng(2))
