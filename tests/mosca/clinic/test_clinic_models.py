"""Each kind of evidence on data made by closed forms: pinhole cameras, points on circles, a fault of known size."""

import numpy as np
import pytest

from mosca.clinic.geometry import geometry_causes
from mosca.clinic.images import marker_image
from mosca.clinic.misfit import fit, residuals_of
from mosca.clinic.observations import PointImages
from mosca.clinic.stamps import StampWitness, stamp_causes
from mosca.clinic.tracks import length_causes, swap_causes
from mosca.data.frames import Frame
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig

RATE, F, SIZE = 60.0, 700.0, (640, 480)
ALPHA = 1e-4


def looking(azimuth, height):
    """Return the pose of a camera on a ring of 2 m that looks at the origin."""
    centre = np.array([2 * np.cos(azimuth), 2 * np.sin(azimuth), height])
    z = -centre / np.linalg.norm(centre)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z], axis=1), centre)


POSES = [looking(a, h) for a, h in ((0.2, 0.2), (1.7, 0.6), (3.3, 0.3), (4.9, 0.7))]
RIG = Rig(tuple(Camera(f"cam{k + 1}", *SIZE, OpenCVLens(F, F, 320, 240), pose) for k, pose in enumerate(POSES)))


def place(t, k):
    """Return where marker k is at times t (n,), and its speed."""
    w, r, a = 2.0 + 0.3 * k, 0.15 + 0.04 * k, 0.9 * k
    at = np.stack([r * np.cos(w * t + a), r * np.sin(w * t + a), 0.2 * np.sin(1.3 * w * t + k)], axis=1)
    speed = np.stack(
        [-r * w * np.sin(w * t + a), r * w * np.cos(w * t + a), 0.26 * w * np.cos(1.3 * w * t + k)], axis=1
    )
    return at, speed


def pinhole(pose, xyz, focal=F, k1=0.0):
    """Return the image (n, 2) by similar triangles, radial distortion k1."""
    v = (xyz - pose.translation) @ pose.rotation
    p = v[:, :2] / v[:, 2:]
    return focal * p * (1 + k1 * (p**2).sum(axis=1, keepdims=True)) + [320, 240]


def observations(image, markers=8, sets=150, seed=3):
    """Return observations whose image of camera c at time t is ``image(c, k, t)``."""
    noise = np.random.default_rng(seed)
    t = np.arange(sets) / RATE
    parts = []
    for k in range(markers):
        at, speed = place(t, k)
        xy = np.stack([image(c, k, t) for c in range(4)], axis=1) + noise.normal(0, 0.06, (sets, 4, 2))
        parts.append((np.arange(sets), t, np.full(sets, k), at, speed, xy))
    frame, time_s, track, xyz, velocity, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    n = len(frame)
    return PointImages(
        frame, time_s, track, xyz, velocity, xy, np.full((n, 4), 0.02), np.zeros((n, 4), int), np.ones(4), 0.3
    )


def causes(image, **more):
    """Return the causes found of images."""
    return geometry_causes(residuals_of(observations(image, **more), RIG, RATE), RIG, 1 / RATE, ALPHA)


def true(c, k, t):
    """Return the image without a fault."""
    return pinhole(POSES[c], place(t, k)[0])


def turned(pose, axis, angle):
    """Return a pose turned about one of its own axes."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = [a for a in range(3) if a != axis]
    turn = np.eye(3)
    turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
    return Pose(pose.rotation @ turn, pose.translation)


def late(camera, delay):
    """Return images of which one camera's are of ``delay(t)`` earlier instants of exposure."""
    return lambda c, k, t: pinhole(POSES[c], place(t + (delay(t) if c == camera else 0.0), k)[0])


def test_nothing_is_found_where_nothing_is_wrong():
    assert causes(true) == []


def test_a_turned_camera_is_named():
    pose = turned(POSES[2], 1, 0.006)
    first = causes(lambda c, k, t: pinhole(pose if c == 2 else POSES[c], place(t, k)[0]))[0]
    assert (first.code, first.camera) == ("camera-moved", "cam3")


def test_a_forgotten_distortion_is_a_wrong_lens():
    first = causes(lambda c, k, t: pinhole(POSES[c], place(t, k)[0], k1=-0.8))[0]
    assert first.code == "wrong-lens"


def test_another_zoom_is_another_resolution():
    first = causes(lambda c, k, t: pinhole(POSES[c], place(t, k)[0], focal=0.94 * F))[0]
    assert first.code == "other-resolution"


@pytest.mark.parametrize(
    ("delay", "code"),
    [
        (lambda t: np.full_like(t, 1 / RATE), "frames-one-off"),
        (lambda t: np.full_like(t, 0.4 / RATE), "sync-lost"),
        (lambda t: 0.008 * t, "sync-lost"),
        (lambda t: (t > 1.2) / RATE, "dropped-unnoticed"),
    ],
)
def test_delays_of_a_camera_are_told_apart(delay, code):
    first = causes(late(1, delay))[0]
    assert (first.code, first.camera) == (code, "cam2")


def test_a_delay_is_measured():
    residuals = residuals_of(observations(late(1, lambda t: np.full_like(t, 0.003))), RIG, RATE)
    design = residuals.flow[..., None] * np.array([0, 1, 0, 0])[None, :, None, None]
    found = fit(residuals, design)
    assert found.values[0] == pytest.approx(0.003, rel=0.03)


def test_a_group_in_another_world_is_two_calibrations():
    shift = np.array([0.015, -0.01, 0.0])
    first = causes(lambda c, k, t: pinhole(POSES[c], place(t, k)[0] + (shift if c in (0, 2) else 0.0)))[0]
    assert first.code == "mixed-calibrations"


def test_drifts_of_all_cameras_are_warming():
    rates = np.array([[2.0, 0.4], [-1.0, 1.6], [0.6, -1.8], [-1.4, -1.4]])
    first = causes(lambda c, k, t: true(c, k, t) + t[:, None] * rates[c])[0]
    assert first.code == "warming"


def test_a_known_length_tells_the_scale():
    seen = observations(true, markers=2)
    second = seen.xyz[seen.track == 0] + [0.26, 0.0, 0.0]  # a rod of 0.25 m, measured 4 % long
    at = seen.xyz.copy()
    at[seen.track == 1] = second
    rod = PointImages(**{**{n: getattr(seen, n) for n in seen.__dataclass_fields__}, "xyz": at})
    (found,) = length_causes(rod, (0.25,), 1e-3, ALPHA)
    assert found.code == "wrong-scale"
    assert found.figures["ratio"] == pytest.approx(1.04, abs=1e-6)
    assert length_causes(rod, (0.2605,), 1e-3, ALPHA) == []


def swapped_places(names, pairs, at):
    """Return name -> frame -> place, with pairs exchanged from a frame on."""
    t = np.arange(100) / RATE
    noise = np.random.default_rng(1)
    of = {n: dict(enumerate(place(t, k)[0] + noise.normal(0, 1e-4, (100, 3)))) for k, n in enumerate(names)}
    out = {name: dict(frames) for name, frames in of.items()}
    for a, b in pairs:
        for f in range(at, 100):
            out[a][f], out[b][f] = of[b][f], of[a][f]
    return out


def test_exchanged_labels_and_bodies_are_told_apart():
    names = [f"d{1 + k // 3}:m{1 + k % 3}" for k in range(6)]
    assert swap_causes(swapped_places(names, [], 50), ALPHA) == []
    (one,) = swap_causes(swapped_places(names, [(names[0], names[4])], 50), ALPHA)
    assert (one.code, one.figures["frame"]) == ("labels-swapped", 50)
    whole = [(names[k], names[k + 3]) for k in range(3)]
    (one,) = swap_causes(swapped_places(names, whole, 50), ALPHA)
    assert one.code == "bodies-swapped"


def witness(times, numbers=None):
    """Return a witness of one camera's stamps [s]."""
    kept = StampWitness()
    for k, t in enumerate(times):
        image = np.zeros((4, 4), np.uint8)
        kept.take(Frame("cam1", k if numbers is None else numbers[k], round(1e9 * t), 0, image))
    return kept


def test_arrival_stamps_scatter_more_than_the_motion():
    residuals = residuals_of(observations(true), RIG, RATE)
    t = np.arange(150) / RATE
    assert stamp_causes(witness(t), residuals, 1 / RATE, ALPHA) == []
    arrived = t + np.random.default_rng(5).exponential(0.0015, 150)
    (found,) = stamp_causes(witness(arrived), residuals, 1 / RATE, ALPHA)
    assert found.code == "arrival-stamps"


def test_a_gap_in_the_stamps_alone_is_a_frame_that_nobody_counted():
    t = np.delete(np.arange(150) / RATE, 70)
    (found,) = stamp_causes(witness(t), None, 1 / RATE, ALPHA)
    assert found.code == "dropped-unnoticed"
    numbers = np.delete(np.arange(150), 70).tolist()
    assert stamp_causes(witness(t, numbers), None, 1 / RATE, ALPHA) == []


@pytest.mark.parametrize("sigma", [0.8, 1.6])
def test_the_edge_of_a_disc_has_the_width_of_its_blur(sigma):
    scipy = pytest.importorskip("scipy.ndimage")
    y, x = np.mgrid[:330, :330]
    fine = 200.0 * (np.hypot(x - 164.5, y - 164.5) < 60)
    coarse = scipy.gaussian_filter(fine, 10 * sigma).reshape(33, 10, 33, 10).mean(axis=(1, 3))
    share, width = marker_image(np.rint(coarse).astype(np.uint8), np.array([16.0, 16.0]), 12.0, 255)
    assert share == 0.0
    # pixels (1/12 px^2) and steps of one pixel widen it, and the three rows averaged are not one
    assert width / np.sqrt(2 * np.pi) == pytest.approx(np.sqrt(sigma**2 + 1 / 6), rel=0.12)
