"""The cloud: distances, speeds and positions that its docstring promises, at every size of working space."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.errors import InputError
from twin.scenes.cloud import build_cloud, closest_approach_m

TIMES = np.linspace(-0.1, 20.1, 60)


@pytest.mark.parametrize("edge", [0.1, 1.0, 10.0])
def test_two_hundred_points_in_working_spaces_of_any_size(edge: float) -> None:
    center, size = np.array([0.0, 1.0, edge]), np.full(3, edge)
    scene = build_cloud(duration_s=20.0, box_center_m=center, box_size_m=size, rng=np.random.default_rng(5))
    sampler = scene.sampler()
    xyz = np.stack([sampler.at(t).marker_xyz for t in TIMES])
    assert xyz.shape[1] == 200
    assert scene.model.ngeom == 200  # nothing else is there
    radius = float(scene.model.geom_size[0, 0])
    assert radius == pytest.approx(0.006 * edge)
    assert (np.abs(xyz - center) + radius < size / 2).all()
    distance = np.linalg.norm(xyz[:, :, None] - xyz[:, None], axis=-1) + 99 * edge * np.eye(200)
    assert distance.min() > closest_approach_m(size, 200, 2 * radius)
    speeds = (scene.sampler().at(0.0).marker_xyz - scene.sampler().at(1e-6).marker_xyz) / 1e-6
    assert 0.05 * edge < np.sqrt(np.mean(np.sum(speeds**2, axis=1))) < 0.5 * edge
    assert np.ptp(xyz, axis=0).min() > 0.02 * edge  # every marker travels


def test_the_speed_is_the_rms_speed() -> None:
    scene = build_cloud(
        duration_s=60.0,
        box_center_m=np.zeros(3),
        box_size_m=np.ones(3),
        rng=np.random.default_rng(1),
        speed_mps=0.35,
        n=60,
    )
    times = np.linspace(0, 60, 1500)
    xyz = np.stack([scene.configuration_at(t) for t in times]).reshape(len(times), -1, 3)
    speeds = np.linalg.norm(np.diff(xyz, axis=0), axis=-1) / (times[1] - times[0])
    assert np.sqrt(np.mean(speeds**2)) == pytest.approx(0.35, rel=0.1)


@settings(max_examples=15, deadline=None)
@given(n=st.integers(1, 90), size=st.tuples(*[st.floats(0.2, 5.0)] * 3), seed=st.integers(0, 1000))
def test_no_two_markers_ever_touch_and_none_leaves(n: int, size: tuple[float, float, float], seed: int) -> None:
    box, diameter = np.array(size), 0.002
    scene = build_cloud(
        duration_s=9.0,
        box_center_m=np.zeros(3),
        box_size_m=box,
        rng=np.random.default_rng(seed),
        n=n,
        marker_diameter_m=diameter,
        speed_mps=0.3,
    )
    xyz = np.stack([scene.configuration_at(t) for t in np.linspace(0, 9, 25)]).reshape(25, n, 3)
    assert (np.abs(xyz) + diameter / 2 <= box / 2 + 1e-12).all()
    distance = np.linalg.norm(xyz[:, :, None] - xyz[:, None], axis=-1) + 99 * np.eye(n)
    assert distance.min() >= closest_approach_m(box, n, diameter) - 1e-12


def test_errors_name_what_is_too_much() -> None:
    def build(n: int, diameter: float) -> None:
        build_cloud(
            duration_s=1.0,
            box_center_m=np.zeros(3),
            box_size_m=np.ones(3),
            rng=np.random.default_rng(0),
            n=n,
            marker_diameter_m=diameter,
        )

    with pytest.raises(InputError, match="take fewer or smaller ones"):
        build(1000, 0.06)
    with pytest.raises(InputError, match="too large for a box"):
        build(2, 1.5)
    with pytest.raises(InputError, match="n = 0"):
        build(0, 0.01)
