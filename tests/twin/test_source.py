"""TwinSource: same seed, same bytes; the truth is what the frames show; leaving and closing free everything."""

import hashlib
import os
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.frames import Frame, FrameSource, mid_exposure_ns
from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.data.truth import Truth
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.scene import MARKER_GROUP, Scene
from twin.source import TwinSource

W, H = 96, 72
FOCAL_PX = 150.0
RATE_HZ, EXPOSURE_S = 100.0, 1e-3
SPEED = np.array([0.3, 0.0, 0.1])
HIDDEN, OUTSIDE, BEHIND = "hidden", "outside", "behind"
STEADY: dict[str, Any] = {"timing": Timing(jitter_s=0.0), "mount": Mount(body_px=0.0), "optics": Optics(gap_px=0.0)}


def scene() -> Scene:
    """A cart on two slides with a ball and a flat marker; others hidden by a wall, outside and behind."""
    spec = mujoco.MjSpec()
    cart = spec.worldbody.add_body(name="cart")
    for axis in ([1.0, 0, 0], [0, 0, 1.0]):
        cart.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    ball, flat = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER
    to_camera = Rotation.from_euler("x", 90, degrees=True).as_quat(scalar_first=True)  # +z of the geom to -y
    box = mujoco.mjtGeom.mjGEOM_BOX
    cart.add_geom(name="ball", type=ball, size=[0.03, 0, 0], pos=[-0.2, 0, 0], group=MARKER_GROUP, mass=1)
    cart.add_geom(name="flat", type=flat, size=[0.03, 1e-4, 0], pos=[0.1, 0, 0.2], quat=to_camera, group=MARKER_GROUP)
    world = spec.worldbody
    world.add_geom(name=HIDDEN, type=ball, size=[0.03, 0, 0], pos=[0.3, 0, -0.3], group=MARKER_GROUP)
    world.add_geom(name="wall", type=box, size=[0.08, 0.01, 0.08], pos=[0.3, -0.3, -0.3])
    world.add_geom(name=OUTSIDE, type=ball, size=[0.03, 0, 0], pos=[5.0, 0, 0], group=MARKER_GROUP)
    world.add_geom(name=BEHIND, type=ball, size=[0.03, 0, 0], pos=[0.0, -9.0, 0], group=MARKER_GROUP)
    model = spec.compile()
    names = ("ball", "flat", HIDDEN, OUTSIDE, BEHIND)
    geoms = tuple(model.geom(name).id for name in names)
    return Scene(model, names, geoms, lambda t: np.array([SPEED[0] * t, SPEED[2] * t]), 2.0)


def camera(name: str, x: float = 0.0, **parts: Any) -> VirtualCamera:
    """Return a camera at (x, -2, 0) with its axis along +y, image x along the world's x."""
    looking = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    lens = OpenCVLens(FOCAL_PX, FOCAL_PX, (W - 1) / 2, (H - 1) / 2)
    view = Camera(name, W, H, lens, Pose(looking, np.array([x, -2.0, 0.0])))
    return VirtualCamera(view, **parts)


RIG = (camera("left", -0.05), camera("right", 0.05, sensor=Sensor(bits=12)))


def session(cameras: tuple[VirtualCamera, ...] = RIG, pulses: int = 6, seed: int = 1, workers: int = 1) -> TwinSource:
    return TwinSource(
        scene(), cameras, frame_rate_hz=RATE_HZ, exposure_s=EXPOSURE_S, pulses=pulses, seed=seed, workers=workers
    )


def digests(source: TwinSource) -> dict[str, str]:
    """Return for each camera a digest of all that its frames hold."""
    sums = {info.name: hashlib.sha256() for info in source.cameras}
    with source:
        for frame in source:
            assert frame.image is not None
            head = f"{frame.index} {frame.time_ns} {frame.exposure_ns} {frame.image.dtype} {frame.image.shape}"
            sums[frame.camera].update(head.encode() + frame.image.tobytes())
    return {name: total.hexdigest() for name, total in sums.items()}


def still_scene() -> Scene:
    return replace(scene(), configuration_at=lambda t: np.zeros(2))


def read(source: TwinSource) -> tuple[list[Frame], Truth]:
    with source:
        frames = list(source)
    return frames, source.truth()


def pinhole_by_hand(xyz: Array, x: float) -> Array:
    """Image (n, 2) of world points by a camera of ``camera(..., x)``: similar triangles."""
    scale = FOCAL_PX / (xyz[:, 1] + 2.0)
    return np.column_stack([(W - 1) / 2 + scale * (xyz[:, 0] - x), (H - 1) / 2 - scale * xyz[:, 2]])


# same seed, same bytes


def test_another_process_makes_the_same_bytes():
    here = Path(__file__).resolve()
    code = f"import sys; sys.path.insert(0, {str(here.parent)!r})\n"
    code += "import test_source as t; print(t.digests(t.session(workers=2)))"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True, text=True, check=True, cwd=here.parents[2], env={**os.environ, "PYTHONHASHSEED": "7"},
    )  # fmt: skip
    assert done.stdout.strip() == str(digests(session()))


def test_a_second_reading_starts_anew():
    source = session()
    assert digests(source) == digests(source)


def test_another_seed_makes_other_bytes():
    one, other = digests(session(seed=1)), digests(session(seed=2))
    assert all(one[name] != other[name] for name in one)


def test_cameras_differ_in_noise():
    # two cameras at one position see the same light, never the same noise
    frames, _truth = read(session((camera("a", **STEADY), camera("b", **STEADY)), pulses=1))
    noise = [frame.image[50:, :30].astype(float) for frame in frames if frame.image is not None]
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 4.5 / np.sqrt(noise[0].size)


@pytest.mark.parametrize("cameras", [(*RIG, camera("new", 0.2)), (camera("new", 0.2), *RIG)], ids=["end", "start"])
def test_a_new_camera_moves_no_other(cameras):
    alone, joined = digests(session()), digests(session(cameras))
    assert {name: joined[name] for name in alone} == alone


@pytest.mark.parametrize(
    "changed",
    [
        camera("right", 0.05, sensor=Sensor(read_noise_e=30.0)),
        camera("right", 0.05, sensor=Sensor(bits=8)),
        camera("right", 0.05, timing=Timing(jitter_s=1e-3)),
        camera("right", 0.05, mount=Mount(body_px=0.5)),
        camera("right", 0.05, optics=Optics(psf_sigma_px=1.0)),
        camera("right", 0.05, marker_signal=0.3),
    ],
    ids=["read noise", "bits", "jitter", "body", "blur", "signal"],
)
def test_noise_of_one_camera_moves_no_other(changed):
    before, after = digests(session()), digests(session((RIG[0], changed)))
    assert after["left"] == before["left"]
    assert after["right"] != before["right"]


def test_one_noise_leaves_the_other_noises_of_a_camera_alone():
    _frames, before = read(session())
    louder = camera("right", 0.05, mount=Mount(body_px=0.0), sensor=Sensor(bits=12, read_noise_e=30.0))
    _frames, after = read(session((RIG[0], louder)))
    np.testing.assert_array_equal(after.exposure_mid_ns, before.exposure_mid_ns)


# frames


def test_frames_are_what_a_camera_gives():
    source = session(pulses=4)
    assert isinstance(source, FrameSource)
    frames, _truth = read(source)
    assert [(f.camera, f.index) for f in frames] == [(n, k) for k in range(4) for n in ("left", "right")]
    assert [(c.name, c.width, c.height, c.bit_depth) for c in source.cameras] == [
        ("left", W, H, 8),
        ("right", W, H, 12),
    ]
    for frame in frames:
        assert frame.image is not None
        assert frame.image.shape == (H, W)
        assert frame.image.dtype == (np.uint8 if frame.camera == "left" else np.uint16)
        assert frame.image.max() < 4096
        assert not frame.image.flags.writeable
        # the time stamp is the pulse's, without jitter
        assert frame.time_ns == frame.index * 10_000_000
        assert frame.exposure_ns == 1_000_000
        assert mid_exposure_ns(frame) == frame.index * 10_000_000 + 500_000


# truth


def test_truth_has_the_shapes_it_states():
    source = session(pulses=5)
    _frames, truth = read(source)
    assert truth.names == ("ball", "flat", HIDDEN, OUTSIDE, BEHIND)
    assert truth.cameras == ("left", "right")
    np.testing.assert_array_equal(truth.time_ns, 10_000_000 * np.arange(5) + 500_000)
    assert truth.xyz.shape == (5, 5, 3)
    assert truth.visible.shape == truth.diameter_px.shape == (5, 5, 2)
    assert truth.image_xy_px.shape == (5, 5, 2, 2)
    assert truth.exposure_mid_ns.shape == (5, 2)


def test_truth_positions_are_those_of_the_nominal_mid_exposure():
    _frames, truth = read(session(pulses=5))
    t = truth.time_ns[:, None] * 1e-9
    np.testing.assert_allclose(truth.xyz[:, 0], np.array([-0.2, 0, 0]) + SPEED * t, atol=1e-12)
    np.testing.assert_allclose(truth.xyz[:, 1], np.array([0.1, 0, 0.2]) + SPEED * t, atol=1e-12)


def test_truth_tells_who_was_seen():
    _frames, truth = read(session(pulses=2))
    np.testing.assert_array_equal(truth.visible[:, :2], 1.0)
    np.testing.assert_array_equal(truth.visible[:, 2:], 0.0)
    for table in (truth.image_xy_px, truth.diameter_px):
        assert np.isnan(table[truth.visible == 0]).all()
        assert np.isfinite(table[truth.visible > 0]).all()


def test_trigger_jitter_is_20_us_rms():
    # default errors: 2 cameras x 400 exposures, so that the rms is known to 2.5 %
    tiny = tuple(replace(v, camera=replace(v.camera, width=8, height=6)) for v in RIG)
    _frames, truth = read(session(tiny, pulses=400, workers=2))
    late = (truth.exposure_mid_ns - truth.time_ns[:, None]) * 1e-9
    assert np.sqrt(np.mean(late**2)) == pytest.approx(20e-6, rel=0.1)
    assert abs(late.mean()) < 4 * 20e-6 / np.sqrt(late.size)
    assert abs(np.corrcoef(late.T)[0, 1]) < 4.5 / np.sqrt(400)


def test_trigger_delay_is_in_the_truth_and_not_in_the_stamps():
    late = camera("left", -0.05, timing=Timing(delay_s=3e-3))
    frames, truth = read(session((late,)))
    _frames, on_time = read(session((RIG[0],)))
    np.testing.assert_array_equal(truth.exposure_mid_ns - on_time.exposure_mid_ns, 3_000_000)
    assert [f.time_ns for f in frames] == [10_000_000 * k for k in range(6)]


def test_true_image_is_that_of_the_true_mid_exposure():
    # 5 ms of jitter: where the marker was at each camera's own mid-exposure, by similar triangles
    jumpy = {**STEADY, "timing": Timing(jitter_s=5e-3)}
    _frames, truth = read(session((camera("left", -0.05, **jumpy), camera("right", 0.05, **jumpy))))
    for number, x in enumerate((-0.05, 0.05)):
        t = truth.exposure_mid_ns[:, number, None] * 1e-9
        for marker, start in ((0, [-0.2, 0, 0]), (1, [0.1, 0, 0.2])):
            expected = pinhole_by_hand(np.array(start) + SPEED * t, x)
            np.testing.assert_allclose(truth.image_xy_px[:, marker, number], expected, atol=1e-6)
    assert np.abs(truth.exposure_mid_ns - truth.time_ns[:, None]).max() > 2e6


def test_camera_body_shakes_by_what_is_stated():
    # 500 exposures of still markers: 0.03 px rms in x and in y, known to 3.2 %
    still = TwinSource(
        still_scene(), (camera("left", -0.05),), frame_rate_hz=RATE_HZ, exposure_s=EXPOSURE_S, pulses=500, seed=4,
        workers=2,
    )  # fmt: skip
    _frames, truth = read(still)
    shake = truth.image_xy_px[:, 0, 0] - truth.image_xy_px[:, 0, 0].mean(axis=0)
    np.testing.assert_allclose(np.sqrt(np.mean(shake**2, axis=0)), 0.03, rtol=0.13)
    assert abs(np.corrcoef(shake.T)[0, 1]) < 4.5 / np.sqrt(500)


def blob_offsets(frames: list[Frame], truth: Truth, markers: tuple[int, ...], later: int = 0) -> Array:
    """Return centre of light minus true image (n, 2) [px]; ``later``: compare with the truth so many pulses on."""
    off = []
    for frame in frames:
        pulse, number = frame.index + later, truth.cameras.index(frame.camera)
        if pulse < len(truth.time_ns):
            places = truth.image_xy_px[pulse, list(markers), number]
            off += [blob_centroid(frame, place) - place for place in places]
    return np.array(off)


def test_the_blobs_lie_where_the_truth_says():
    # centre of light in a window against the marker centre's true image, body shake and all.
    # Measured: 0.0007 px on average, spread 0.006 px
    eyes = tuple(camera(n, x, sensor=Sensor(bits=12)) for n, x in (("left", -0.05), ("right", 0.05)))
    frames, truth = read(session(eyes, pulses=60, workers=2))
    off = blob_offsets(frames, truth, (0, 1))
    assert np.abs(off.mean(axis=0)).max() < 0.005
    assert off.std(axis=0).max() < 0.02
    # control: the truth of the next pulse is noticed
    assert np.abs(blob_offsets(frames, truth, (0, 1), later=1).mean(axis=0)).max() > 0.05


def test_a_streak_lies_at_its_mid_exposure():
    # 6 m/s for 10 ms: 4.5 px of blur; had the truth meant the exposure's start, it would be 2.2 px off
    fast = replace(scene(), configuration_at=lambda t: np.array([6.0 * t, 1.5 * t]))
    eye = camera("eye", sensor=Sensor(bits=12))
    frames, truth = read(TwinSource(fast, (eye,), frame_rate_hz=50.0, exposure_s=10e-3, pulses=5, seed=3))
    off = blob_offsets(frames, truth, (0,))
    assert np.abs(off).max() < 0.03
    assert np.abs(np.diff(truth.image_xy_px[:, 0, 0, 0]) - 9.0).max() < 0.1


def blob_centroid(frame: Frame, near: Array, half: int = 8) -> Array:
    """Return the centre of light (2,) [px] above the image's median, in a window about ``near``."""
    assert frame.image is not None
    x, y = (round(float(c)) for c in near)
    window = frame.image[y - half : y + half + 1, x - half : x + half + 1] - np.median(frame.image)
    rows, columns = np.mgrid[y - half : y + half + 1, x - half : x + half + 1]
    return np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum()


# leaving and closing


def test_leaving_early_frees_the_workers():
    before = set(threading.enumerate())
    source = session(pulses=200, workers=3)
    frames = iter(source)
    read_before_leaving = [next(frames) for _ in range(5)]
    assert set(threading.enumerate()) > before
    frames.close()
    assert set(threading.enumerate()) == before
    # the truth covers the pulses that were read, the broken third included
    truth = source.truth()
    assert len(truth.time_ns) == 3
    complete = list(session(pulses=3))
    for early, whole in zip(read_before_leaving, complete, strict=False):
        np.testing.assert_array_equal(early.image, whole.image)


def test_an_error_in_the_reader_frees_the_workers():
    def break_off() -> None:
        with session(pulses=200, workers=2) as source:
            for frame in source:
                raise LookupError(frame.camera)

    before = set(threading.enumerate())
    with pytest.raises(LookupError, match="left"):
        break_off()
    assert set(threading.enumerate()) == before


def test_closing_twice_and_before_reading():
    source = session(pulses=2)
    source.close()
    source.close()
    assert len(list(source)) == 4
    source.close()


@pytest.mark.parametrize("read_before", [1, 2, 7, 40])
def test_a_source_closed_while_it_is_read_ends(read_before):
    before = set(threading.enumerate())
    source = session(pulses=20, workers=2)
    frames = iter(source)
    for _ in range(read_before):
        next(frames)
    source.close()
    assert list(frames) == []
    assert set(threading.enumerate()) == before


def test_two_readings_at_once_leave_each_other_alone():
    alone = list(session(pulses=8))
    source = session(pulses=8, workers=2)
    one, other = iter(source), iter(source)
    first = [next(one) for _ in range(6)]
    second = [next(other) for _ in range(3)]
    # the truth is that of the reading started last: two pulses of it are read, of the first three
    assert len(source.truth().time_ns) == 2
    first += list(one)
    assert len(source.truth().time_ns) == 2
    second += list(other)
    assert len(source.truth().time_ns) == 8
    for frames in (first, second):
        assert [(f.camera, f.index) for f in frames] == [(f.camera, f.index) for f in alone]
        for frame, expected in zip(frames, alone, strict=True):
            np.testing.assert_array_equal(frame.image, expected.image)


def test_no_pulses_make_an_empty_truth():
    frames, truth = read(session(pulses=0))
    assert frames == []
    assert truth.xyz.shape == (0, 5, 3)
    assert truth.exposure_mid_ns.shape == (0, 2)
