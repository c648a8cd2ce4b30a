"""Jitter, delays, shake and rolling shutters against pinhole images written here in plain numpy."""

from types import SimpleNamespace

import numpy as np
import pytest

from mosca.accuracy.lab_twin.estimates import NotTold
from mosca.accuracy.lab_twin.moving_targets import frame_sums, observe
from mosca.accuracy.lab_twin.timing import KEYS, fit_mixed_model, timing_estimates
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig

F, SIZE = 700.0, (640, 480)
NOISE_PX = 0.01


def camera(name, azimuth):
    """Return a pinhole camera 3 m from the origin that looks at it, y downwards."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    rotation = np.array([[-s, 0.0, -c], [c, 0.0, -s], [0.0, -1.0, 0.0]])
    lens = OpenCVLens(F, F, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    return Camera(name, *SIZE, lens, Pose(rotation, np.array([3.0 * c, 3.0 * s, 0.0])))


def image(one, xyz):
    """Return pixels by the pinhole's own formula."""
    own = (xyz - one.world_from_camera.translation) @ one.world_from_camera.rotation
    return F * own[:, :2] / own[:, 2:] + (np.array(SIZE) - 1) / 2


class Found(SimpleNamespace):
    """Points of a frame set."""

    def __len__(self):
        return len(self.xyz)


def steps(*, delay, jitter, shake, row_s=0.0, sets=150, points=20, speed=6.0, seed=1):
    """Return a rig and frame sets of points on circles, imaged late, shaken and row by row."""
    random = np.random.default_rng(seed)
    rig = Rig(tuple(camera(f"c{k}", 0.4 + 2.1 * k) for k in range(len(delay))))
    phase, rate = random.uniform(0, 6.28, (2, points, 3))[0], speed * random.uniform(0.5, 1.0, (points, 3))

    def place(time):
        return 0.6 * np.sin(phase + rate * np.asarray(time).reshape(-1, 1))

    made = []
    for k in range(sets):
        time = 0.01 * k
        detections, frames = {}, {}
        for c, one in enumerate(rig.cameras):
            late = delay[c] + random.normal(0.0, jitter[c])
            xy = image(one, place(np.full(points, time + late)))
            for _ in range(4):
                rows = row_s * (xy[:, 1] - (SIZE[1] - 1) / 2)
                xy = image(one, place(time + late + rows))
            xy = xy + random.normal(0.0, shake[c], 2) + random.normal(0.0, NOISE_PX, xy.shape)
            spread = np.broadcast_to(NOISE_PX**2 * np.eye(2), (points, 2, 2))
            detections[one.name] = SimpleNamespace(xy_px=xy, covariance_px2=spread, flags=np.zeros(points, int))
            frames[one.name] = SimpleNamespace(
                time_ns=round(1e9 * time), exposure_ns=0, row_time_ns=0, rows=SIZE[1], stamp_event="exposure_middle"
            )
        found = Found(xyz=place(np.full(points, time)), rays=np.tile(np.arange(points)[:, None], (1, len(delay))))
        frame_set = SimpleNamespace(pulse=k, time_ns=round(1e9 * time), frames=frames)
        made.append(SimpleNamespace(frame_set=frame_set, detections=detections, points=found))
    return rig, made


def told(rig, made):
    return {(one.camera, one.key): one for one in timing_estimates(observe(made, rig), rig.names)}


def test_delays_jitter_and_shake_come_back():
    delay, jitter, shake = (1e-4, -5e-5, 2e-4), (8e-5, 1.5e-4, 3e-5), (0.05, 0.02, 0.04)
    rig, made = steps(delay=delay, jitter=jitter, shake=shake)
    found = told(rig, made)
    for k, name in enumerate(rig.names):
        late, wide = found[name, "timing.delay_s"], found[name, "errors.trigger_jitter_s"]
        assert abs(late.value - (delay[k] - np.mean(delay))) < 4.0 * late.sigma < 1e-4
        assert abs(wide.value - jitter[k]) < 4.0 * wide.sigma
        assert found[name, "timing.row_time_s"].value == 0.0
    assert found["c1", "errors.trigger_jitter_s"].sigma < 3e-5
    model = fit_mixed_model(frame_sums(observe(made, rig)))
    assert np.all(np.abs(model.shake[0] - np.array(shake) ** 2) < 4.0 * model.shake[1])


def test_the_noise_of_images_comes_out_as_the_unit_variance():
    rig, made = steps(delay=(0.0,) * 3, jitter=(1e-4,) * 3, shake=(0.05,) * 3)
    assert frame_sums(observe(made, rig)).variance == pytest.approx(1.0, rel=0.1)


def test_a_rolling_shutter_comes_back():
    rig, made = steps(delay=(0.0,) * 3, jitter=(2e-5,) * 3, shake=(0.02,) * 3, row_s=1e-5)
    found = told(rig, made)
    for name in rig.names:
        one = found[name, "timing.row_time_s"]
        assert abs(one.value - 1e-5) < 4.0 * one.sigma + 2e-7
        assert one.sigma < 2e-6


def test_mistaken_images_do_not_count():
    rig, made = steps(delay=(1e-4, 0.0, -1e-4), jitter=(5e-5,) * 3, shake=(0.02,) * 3)
    random = np.random.default_rng(2)
    for step in made:
        step.detections["c1"].xy_px[random.integers(0, 20, 2)] += random.normal(0.0, 3.0, (2, 2))
    found = told(rig, made)
    one = found["c0", "timing.delay_s"]
    assert abs(one.value - 1e-4) < 4.0 * one.sigma < 6e-5


def test_what_lacks_is_named():
    for one in timing_estimates(None, ("a", "b")):
        assert isinstance(one, NotTold)
        assert "moving targets" in one.reason
    rig, made = steps(delay=(0.0,) * 3, jitter=(0.0,) * 3, shake=(0.05,) * 3, speed=1e-4, sets=40)
    slow = timing_estimates(observe(made, rig), rig.names)
    assert {one.key for one in slow} == set(KEYS)
    assert all("faster" in one.reason for one in slow)
