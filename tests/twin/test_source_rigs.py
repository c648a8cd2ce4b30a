"""Rigs as they really are: rolling, free running, strobed, shaken, riding, losing frames; against closed forms."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_source import (
    EXPOSURE_S,
    FOCAL_PX,
    RATE_HZ,
    RIG,
    SPEED,
    STEADY,
    H,
    W,
    blob_centroid,
    camera,
    digests,
    pinhole_by_hand,
    read,
    scene,
    session,
    still_scene,
)

from mosca.data.arrays import Array
from mosca.data.frames import Frame, mid_exposure_ns
from mosca.data.truth import NO_FRAME, TABLES, Truth, read_truth, write_truth
from mosca.errors import InputError
from mosca.synchronisation import Assembly, assemble
from twin.cameras.delivery import Delivery, fate_of
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.stray_light.context_image import Context
from twin.cameras.stray_light.glare import Glare
from twin.cameras.stray_light.stray import Surroundings
from twin.cameras.stray_light.world import RingLight
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.emission import Blink, Glow
from twin.source import TwinSource

BALL_AT, FLAT_AT = np.array([-0.2, 0.0, 0.0]), np.array([0.1, 0.0, 0.2])
QUIET = Sensor(bits=12, background_e=20.0)


def steady(name: str, x: float = 0.0, **parts: Any) -> VirtualCamera:
    return camera(name, x, **{**STEADY, "sensor": QUIET, **parts})


def source(
    cameras: tuple[VirtualCamera, ...], *, pulses: int = 6, workers: int = 1, of: Any = None, **words: Any
) -> TwinSource:
    given = {"frame_rate_hz": RATE_HZ, "exposure_s": EXPOSURE_S, "seed": 1, **words}
    return TwinSource(scene() if of is None else of, cameras, pulses=pulses, workers=workers, **given)


def riding(name: str, **parts: Any) -> VirtualCamera:
    """A camera on the cart, 2 m behind it, looking along +y."""
    return steady(name, mount=Mount(body_px=0.0, body="cart"), **parts)


MIXED = (
    camera("global", -0.05),
    camera("rolling", 0.05, timing=Timing(row_time_s=40e-6)),
    camera("free", 0.0, timing=Timing(rate_hz=137.0, offset_s=2e-3, drift_ppm=50.0)),
    camera("shaken", 0.1, mount=Mount(vibration_px=0.4, wander_px=0.1, bump_s=0.05, bump_px=(2.0, 1.0))),
    VirtualCamera(camera("riding", 0.2).camera, mount=Mount(body="cart")),
    camera("strobed", -0.2, timing=Timing(strobe_s=2e-4, strobe_delay_s=3e-4)),
)
TROUBLED = {"global": Delivery(late_share=0.2, late_frames=9), "free": Delivery(doubled_share=0.3, dropped_share=0.1)}


# same seed, same bytes


@pytest.mark.parametrize("workers", [2, 3])
def test_workers_change_no_byte_of_a_mixed_rig(workers: int) -> None:
    one, more = (source(MIXED, pulses=14, workers=n, deliveries=TROUBLED) for n in (1, workers))
    first, second = list(one), list(more)
    assert [(f.camera, f.index, f.time_ns) for f in first] == [(f.camera, f.index, f.time_ns) for f in second]
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
    for name in ("xyz", "image_xy_px", "camera_rotation", "exposure_mid_ns"):
        np.testing.assert_array_equal(getattr(one.truth(), name), getattr(more.truth(), name))


@pytest.mark.parametrize("workers", [2, 3])
def test_surroundings_change_no_byte_either(workers: int) -> None:
    around = Surroundings(Context(rate_hz=30.0), RingLight(), glare=Glare(0.02))
    made = [digests(source(MIXED, workers=n, surroundings=around)) for n in (1, workers)]
    assert made[0] == made[1]
    plain = digests(source(MIXED))
    assert all(made[0][name] != plain[name] for name in plain)


# free running


def test_free_cameras_keep_their_own_time() -> None:
    free = Timing(jitter_s=0.0, rate_hz=137.0, offset_s=2e-3, drift_ppm=1000.0, clock="device", clock_offset_s=5.0)
    both = source((steady("fixed"), steady("free", timing=free)), pulses=50)
    assert [info.frame_rate_hz for info in both.cameras] == [RATE_HZ, 137.0]
    assert both.cameras[1].clock == "device"
    frames, truth = read(both)
    mine = [f for f in frames if f.camera == "free"]
    # 2 ms + n / 137.137 s, below half a second: 0 to 68
    assert [f.index for f in mine] == list(range(69))
    middle_s = 2e-3 + np.arange(69) / 137.137 + EXPOSURE_S / 2
    np.testing.assert_allclose([mid_exposure_ns(f) for f in mine], 5e9 + middle_s * 1e9, atol=2)
    table = truth.frames
    assert table is not None
    np.testing.assert_array_equal(table.camera, 1)
    np.testing.assert_array_equal(table.index, np.arange(69))
    np.testing.assert_array_equal(table.stamp_ns, [f.time_ns for f in mine])
    np.testing.assert_allclose(table.exposure_mid_ns, middle_s * 1e9, atol=1)
    for marker, start in ((0, BALL_AT), (1, FLAT_AT)):
        place = start + SPEED * middle_s[:, None]
        np.testing.assert_allclose(table.xyz[:, marker], place, atol=1e-12)
        np.testing.assert_allclose(table.image_xy_px[:, marker], pinhole_by_hand(place, 0.0), atol=1e-6)
    # the table of pulses holds the frame that is nearest
    for pulse in (0, 1, 7, 49):
        near = table.exposure_mid_ns[np.floor(table.exposure_mid_ns * 1e-9 * RATE_HZ - 0.05) == pulse]
        assert truth.exposure_mid_ns[pulse, 1] in near


def test_a_slow_camera_leaves_pulses_without_a_frame() -> None:
    slow = Timing(jitter_s=0.0, rate_hz=25.0)
    _frames, truth = read(source((steady("fixed"), steady("slow", timing=slow)), pulses=8))
    took = truth.exposure_mid_ns[:, 1] != NO_FRAME
    np.testing.assert_array_equal(took, [True, False, False, False] * 2)
    assert truth.camera_position is not None
    np.testing.assert_array_equal(truth.visible[~took, :, 1], 0.0)
    assert np.isnan(truth.image_xy_px[~took, :, 1]).all()
    assert np.isnan(truth.camera_position[~took, 1]).all()
    assert (truth.exposure_mid_ns[:, 0] != NO_FRAME).all()


def test_triggered_rigs_have_no_table_of_frames() -> None:
    _frames, truth = read(session(pulses=2))
    assert truth.frames is None


# shutters and strobes


def test_a_rolling_shutter_shows_each_row_at_its_own_time() -> None:
    # a marker in row v is seen at start + v rows + half the exposure: solved for v by hand, since it moves
    row_s = 80e-6
    fast = replace(scene(), configuration_at=lambda t: np.array([3.0 * t, 1.5 * t]))
    eye = steady("eye", timing=Timing(jitter_s=0.0, row_time_s=row_s))
    frames, truth = read(source((eye,), pulses=8, of=fast))
    scale = FOCAL_PX / 2.0
    for frame in frames:
        t0 = frame.index / RATE_HZ + EXPOSURE_S / 2
        for marker, start in ((0, BALL_AT), (1, FLAT_AT)):
            v0 = (H - 1) / 2 - scale * (start[2] + 1.5 * t0)
            v = v0 / (1.0 + scale * 1.5 * row_s)
            u = (W - 1) / 2 + scale * (start[0] + 3.0 * (t0 + v * row_s))
            if 5 < u < W - 5 and 5 < v < H - 5:
                np.testing.assert_allclose(truth.image_xy_px[frame.index, marker, 0], [u, v], atol=2e-4)
                np.testing.assert_allclose(blob_centroid(frame, np.array([u, v]), 5), [u, v], atol=0.03)
    # the truth's instant is the central row's, as the frame states
    np.testing.assert_allclose(truth.exposure_mid_ns[:, 0], [mid_exposure_ns(f) for f in frames], atol=1)
    assert frames[0].row_time_ns == 80_000


def light_of(frames: list[Frame], sensor: Sensor = QUIET) -> float:
    """Electrons above the dark image, on average over the frames."""
    images = np.array([f.image for f in frames], dtype=float)
    return float((images - sensor.black).sum(axis=(1, 2)).mean() / sensor.gain_dn_per_e - W * H * sensor.background_e)


def test_a_strobe_decides_the_instant_and_the_light() -> None:
    fast = replace(scene(), configuration_at=lambda t: np.array([6.0 * t, 0.0]))
    strobe = Timing(jitter_s=0.0, exposure_s=8e-3, strobe_s=2e-3, strobe_delay_s=5e-3)
    open_ = Timing(jitter_s=0.0, exposure_s=8e-3)
    lit, truth = read(source((steady("eye", timing=strobe),), pulses=4, of=fast))
    always, _truth = read(source((steady("eye", timing=open_),), pulses=4, of=fast))
    for frame in lit:
        instant = frame.index / RATE_HZ + 6e-3
        assert truth.exposure_mid_ns[frame.index, 0] == round(instant * 1e9)
        assert mid_exposure_ns(frame) == round(instant * 1e9)
        place = pinhole_by_hand(np.array([BALL_AT + [6.0 * instant, 0.0, 0.0]]), 0.0)[0]
        # a quarter of the light; by the window's middle it would be 0.9 px off
        np.testing.assert_allclose(blob_centroid(frame, place), place, atol=0.1)
    assert light_of(lit) / light_of(always) == pytest.approx(0.25, rel=0.02)


def test_a_lamp_that_blinks_twice_in_an_exposure_gives_both_flashes() -> None:
    # 8 ms of exposure, bits of 1 ms: 1 0 1 1 0 0 1 0 has four of them on
    bits = tuple(bool(b) for b in (1, 0, 1, 1, 0, 0, 1, 0))
    slow = Timing(jitter_s=0.0, exposure_s=8e-3)
    shown = {}
    for name, blink in (("code", Blink(bits, 1e-3)), ("always", None)):
        lamps = replace(still_scene(), glows={n: Glow("lamp", blink=blink) for n in ("ball", "flat")})
        frames, _truth = read(source((steady("eye", timing=slow),), pulses=4, of=lamps, frame_rate_hz=125.0))
        shown[name] = light_of(frames)
    assert shown["code"] / shown["always"] == pytest.approx(0.5, rel=0.01)


def test_a_skewed_camera_comes_later() -> None:
    skewed = steady("skewed", timing=Timing(jitter_s=0.0, skew_s=2e-3))
    frames, truth = read(source((skewed, steady("prompt")), pulses=2))
    assert [f.camera for f in frames] == ["prompt", "skewed"] * 2
    assert [f.time_ns for f in frames] == [0, 2_000_000, 10_000_000, 12_000_000]
    np.testing.assert_array_equal(truth.exposure_mid_ns[0], [2_500_000, 500_000])


# mounts and lenses


def seen_by_pinhole(truth: Truth, pulse: int, number: int) -> Array:
    """Image (m, 2) of the true positions through the true pose, by similar triangles."""
    assert truth.camera_rotation is not None
    assert truth.camera_position is not None
    here = (truth.xyz[pulse] - truth.camera_position[pulse, number]) @ truth.camera_rotation[pulse, number]
    return np.array([(W - 1) / 2, (H - 1) / 2]) + FOCAL_PX * here[:, :2] / here[:, 2:]


def test_the_truth_knows_where_each_camera_really_stood() -> None:
    moving = Mount(
        body_px=0.5, vibration_px=0.5, drift_px_per_s=(20.0, -10.0), wander_px=0.5, bump_s=0.03, bump_px=(3.0, 0.0),
        bump_m=(0.01, 0.0, 0.0),
    )  # fmt: skip
    _frames, truth = read(source((steady("still"), steady("moving", mount=moving)), pulses=8, of=still_scene()))
    for pulse in range(8):
        for number in range(2):
            got, expected = truth.image_xy_px[pulse, :2, number], seen_by_pinhole(truth, pulse, number)[:2]
            np.testing.assert_allclose(got, expected, atol=1e-6)
    moved = truth.image_xy_px[:, 0, 1] - truth.image_xy_px[:, 0, 0]
    assert np.abs(moved[5:] - moved[:3]).max() > 2.0
    np.testing.assert_allclose(np.ptp(truth.image_xy_px[:, 0, 0], axis=0), 0.0, atol=1e-12)


def test_a_camera_that_rides_sees_its_own_body_stand_still() -> None:
    frames, truth = read(source((riding("rider"),), pulses=5))
    for marker, start in ((0, BALL_AT), (1, FLAT_AT)):
        by_hand = pinhole_by_hand(start[None], 0.0)[0]
        np.testing.assert_allclose(truth.image_xy_px[:, marker, 0], np.tile(by_hand, (5, 1)), atol=1e-6)
        np.testing.assert_allclose(blob_centroid(frames[3], by_hand), by_hand, atol=0.03)
    assert truth.camera_position is not None
    t = truth.exposure_mid_ns * 1e-9
    np.testing.assert_allclose(truth.camera_position[:, 0], np.array([0, -2.0, 0]) + SPEED * t, atol=1e-9)


def test_a_rolling_camera_rides_too() -> None:
    rider = riding("rider", timing=Timing(jitter_s=0.0, row_time_s=50e-6))
    _frames, truth = read(source((rider,), pulses=3))
    by_hand = pinhole_by_hand(FLAT_AT[None], 0.0)[0]
    np.testing.assert_allclose(truth.image_xy_px[:, 1, 0], np.tile(by_hand, (3, 1)), atol=1e-6)


def test_a_warming_lens_moves_the_image() -> None:
    warm = replace(Optics(gap_px=0.0), principal_point_px_per_s=(5.0, -2.0))
    _frames, truth = read(source((steady("warm", optics=warm),), pulses=8, of=still_scene()))
    drift = truth.image_xy_px[7, 0, 0] - truth.image_xy_px[0, 0, 0]
    np.testing.assert_allclose(drift, 0.07 * np.array([5.0, -2.0]), atol=1e-9)


# delivery


def test_what_the_link_loses_the_assembly_counts() -> None:
    small = tuple(replace(v, camera=replace(v.camera, width=8, height=6)) for v in RIG)
    troubled = Delivery(dropped_share=0.1, corrupt_share=0.1, doubled_share=0.1, dies_s=2.0, returns_s=2.5)
    lossy = source(small, pulses=300, deliveries={"right": troubled})
    counts = Assembly()
    sets = list(assemble(lossy, lossy.cameras, assembly=counts))
    fates = [fate_of(troubled, 1, "right", k, k / RATE_HZ) for k in range(300)]
    count = counts.cameras["right"]
    assert len(sets) == 300
    assert counts.cameras["left"].delivered == 300
    # the frame at 2 s opens within the jitter of the instant at which the camera dies
    assert abs(count.dropped - fates.count("dropped") - fates.count("dead")) <= 2
    assert count.corrupt == fates.count("corrupt") > 10
    assert count.doubled == fates.count("doubled") > 10
    # what is lost on the way was taken all the same
    assert len(lossy.truth().time_ns) == 300


# files of the truth


def test_the_truth_survives_its_file(tmp_path: Path) -> None:
    _frames, truth = read(source(MIXED, pulses=4))
    write_truth(truth, tmp_path / "truth.npz")
    again = read_truth(tmp_path / "truth.npz")
    for name in Truth.__dataclass_fields__:
        if name not in TABLES:
            np.testing.assert_array_equal(getattr(again, name), getattr(truth, name))
    assert truth.frames is not None
    assert again.frames is not None
    for name in truth.frames.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again.frames, name), getattr(truth.frames, name))


def test_a_truth_of_before_is_still_read(tmp_path: Path) -> None:
    _frames, truth = read(session(pulses=2))
    names = ["time_ns", "names", "xyz", "visible", "cameras", "image_xy_px", "diameter_px", "exposure_mid_ns"]
    np.savez_compressed(tmp_path / "old.npz", **{name: np.asarray(getattr(truth, name)) for name in names})
    old = read_truth(tmp_path / "old.npz")
    assert (old.camera_rotation, old.camera_position, old.frames, old.joints) == (None,) * 4
    np.testing.assert_array_equal(old.xyz, truth.xyz)


# what cannot be


@pytest.mark.parametrize(
    ("cameras", "words", "named"),
    [
        ((steady("eye", mount=Mount(body="torso")),), {}, "camera 'eye', mount: body = 'torso' given; .*cart"),
        ((steady("eye", timing=Timing(row_time_s=1e-3)),), {}, "camera 'eye', timing: .*row_time_s"),
        ((steady("eye"),), {"deliveries": {"ear": Delivery()}}, "deliveries: camera 'ear' given; the rig has eye"),
    ],
    ids=["body", "rows", "delivery"],
)  # fmt: skip
def test_what_cannot_be_is_named(cameras: Any, words: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=named):
        source(cameras, **words)
