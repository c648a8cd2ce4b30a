"""Each kind of evidence on data made by closed forms: pinhole cameras, points on circles, a fault of known size."""

import numpy as np
import pytest

from mosca.clinic.diagnose import diagnose_frames, diagnose_tracks
from mosca.clinic.geometry import geometry_causes
from mosca.clinic.images import ImageWitness, image_causes, marker_image
from mosca.clinic.misfit import fit, residuals_of
from mosca.clinic.observations import PointImages, observe
from mosca.clinic.stamps import StampWitness, stamp_causes
from mosca.clinic.tracks import length_causes, swap_causes
from mosca.data.detections import Detections
from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.data.tracks import Tracks

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


def test_what_no_image_shows_is_not_found():
    """A fault of a camera that saw nothing at that time: no parameter, and no division of nothing by nothing."""
    residuals = residuals_of(observations(true), RIG, RATE)
    design = np.stack([residuals.flow, np.zeros_like(residuals.flow)], axis=-1)
    with np.errstate(all="raise", under="ignore"):
        found = fit(residuals, design)
        nothing = fit(residuals, design[..., 1:])
    assert np.isfinite(found.covariance).all()
    assert (found.values[1], nothing.values[0], nothing.p_value, nothing.moved_px) == (0.0, 0.0, 1.0, 0.0)


def test_images_of_few_markers_that_are_off_are_no_fault_of_the_rig():
    """Three of eight markers are half hidden in one camera: their images are off along a lens's field."""

    def half_hidden(c, k, t):
        return pinhole(POSES[c], place(t, k)[0], k1=-3.0 if k < 3 and c == 1 else 0.0)

    assert residuals_of(observations(half_hidden), RIG, RATE).unit_weight > 3
    assert causes(half_hidden) == []
    of_all = causes(lambda c, k, t: pinhole(POSES[c], place(t, k)[0], k1=-3.0 if c == 1 else 0.0))
    assert of_all[0].code == "wrong-lens"


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


def recorded_tracks(times, exposed=None, markers=4):
    """Return tracks of markers that were exposed at ``exposed`` [s] and recorded with stamps ``times`` [s]."""
    n = len(times)
    exposed = times if exposed is None else exposed
    xyz = np.stack([place(exposed, k)[0] for k in range(markers)], axis=1).reshape(-1, 3)
    xyz = xyz + np.random.default_rng(8).normal(0, 5e-5, xyz.shape)
    m = n * markers
    return Tracks(
        np.repeat(np.arange(n), markers), np.repeat(np.rint(1e9 * times).astype(np.int64), markers),
        np.tile(np.arange(markers), n), np.full(m, ""), xyz, np.tile(1e-8 * np.eye(3), (m, 1, 1)), np.full(m, 3),
        np.full(m, 0.1), np.full(m, "measured"),
    )  # fmt: skip


def test_stamps_of_arrival_in_what_a_client_recorded():
    even = np.arange(200) / RATE
    arrived = even + np.random.default_rng(5).exponential(0.003, 200)
    (found,) = diagnose_tracks(recorded_tracks(arrived, even), None).causes
    assert found.code == "arrival-stamps"
    assert found.figures["scatter_s"] == pytest.approx(0.003, rel=0.2)
    # exposed when the stamps say, or stamps that a file rounds
    assert diagnose_tracks(recorded_tracks(arrived), None).causes == ()
    assert diagnose_tracks(recorded_tracks(np.round(even, 2), even), None).causes == ()
    assert diagnose_tracks(recorded_tracks(even), None).causes == ()


def test_a_gap_in_the_stamps_of_what_a_client_recorded():
    t = np.delete(np.arange(150) / RATE, [70, 71])
    (found,) = diagnose_tracks(recorded_tracks(t), None).causes
    assert found.code == "dropped-unnoticed"
    assert "3 periods after frame 69" in found.evidence[0]


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


BALL_M = 0.06


def seen_balls(sets=20, markers=4):
    """Yield frame sets of large balls, outlined by the cones that touch them.

    The ellipse's centre is at x z / (z^2 - r^2) in the plane z = 1.
    """
    for n in range(sets):
        t = np.array([n / RATE])
        centres = np.concatenate([place(t, k)[0] for k in range(markers)])
        found = {}
        for camera in RIG.cameras:
            pose = camera.world_from_camera
            v = (centres - pose.translation) @ pose.rotation
            xy = F * v[:, :2] * v[:, 2:] / (v[:, 2:] ** 2 - BALL_M**2) + [320, 240]
            size = 2 * F * BALL_M / np.linalg.norm(v, axis=1)
            one = np.ones(markers)
            found[camera.name] = Detections(
                camera.name, xy, np.tile(1e-4 * np.eye(2), (markers, 1, 1)), size, 200 * one, one
            )
        yield FrameSet(n, round(1e9 * n / RATE)), found, 0.0


def test_images_of_balls_are_freed_of_their_eccentricity():
    seen = list(seen_balls())
    observed = observe(seen, RIG)
    assert len(observed) > 40
    off, raw = [], []
    for row in range(len(observed)):
        centres = np.concatenate([place(observed.time_s[row : row + 1], k)[0] for k in range(4)])
        truth = centres[np.argmin(np.linalg.norm(centres - observed.xyz[row], axis=1))]
        for c, pose in enumerate(POSES):
            here = pinhole(pose, truth[None])[0]
            off.append(observed.xy_px[row, c] - here)
            raw.append(np.min(np.linalg.norm(seen[observed.frame[row]][1][f"cam{c + 1}"].xy_px - here, axis=1)))
    assert np.quantile(raw, 0.9) > 0.05  # what is taken off
    np.testing.assert_allclose(off, 0.0, atol=0.01)


@pytest.mark.parametrize("detections", [7784, 7785, 7788])
@pytest.mark.parametrize(("connected", "codes"), [(1.0, ["markers-merged", "saturated"]), (0.4, [])])
def test_images_of_markers_are_judged_at_any_number_of_detections(detections, connected, codes):
    """A quarter is merged and three quarters are white; what meets no other camera's rays may be no markers."""
    witness = ImageWitness([CameraInfo("cam1", *SIZE, 8, RATE)])
    one = witness.sums["cam1"]
    one.detections, one.merged = detections, detections // 4
    one.white = [0.9] * (3 * detections // 4) + [0.0] * (detections // 4)
    found = image_causes(witness, {"cam1": connected}, RATE, ALPHA)
    assert sorted(one.code for one in found) == codes
    assert all(one.p_value < 1e-6 for one in found)


def test_few_merged_images_are_no_fault():
    witness = ImageWitness([CameraInfo("cam1", *SIZE, 8, RATE)])
    one = witness.sums["cam1"]
    one.detections, one.merged, one.white = 1501, 150, [0.0] * 1501
    assert image_causes(witness, {"cam1": 1.0}, RATE, ALPHA) == []


class Rooms:
    """Four cameras' frames in which pairs of touching white blobs lie anywhere: no camera sees what another does."""

    cameras = tuple(CameraInfo(name, *SIZE, 8, RATE) for name in RIG.names)

    def __iter__(self):
        noise, y, x = np.random.default_rng(5), *np.mgrid[-6:7, -6:16]
        pair = 240.0 * ((np.hypot(x, y) < 5) | (np.hypot(x - 9, y) < 5))
        fixed = {name: noise.integers(40, 440, (3, 2)) for name in RIG.names}
        for n in range(20):
            for name in RIG.names:
                image = noise.normal(20, 1, (SIZE[1], SIZE[0]))
                for across, down in [*noise.integers(40, 440, (6, 2)), *fixed[name]]:
                    image[down - 6 : down + 7, across - 6 : across + 16] += pair
                yield Frame(name, n, round(1e9 * n / RATE), 0, np.clip(image, 0, 255).astype(np.uint8))


def test_what_no_other_camera_sees_is_not_taken_for_markers():
    """Blobs are merged, white, and some never move: a board or a room, and no fault of a take of markers."""
    report = diagnose_frames(Rooms(), RIG)
    assert report.causes == ()
    assert "these are other things than markers" in report.not_judged[0]
