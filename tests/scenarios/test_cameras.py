"""From a scenario's words to cameras: what is merged, what rides, what is windowed, and which words are refused."""

from pathlib import Path

import numpy as np
import pytest

from mosca.camera.projection import project
from mosca.data.rig import Camera, FisheyeLens, MoscaLens, OpenCVLens, Pose
from mosca.errors import InputError
from scenarios.build.camera_ring import ring, windowed
from scenarios.build.cameras import calibrated, deliveries, surroundings, true_rig, virtual_cameras
from scenarios.spec.cameras import Cameras
from scenarios.spec.scenario import Scenario, load_scenario

BASE = """
title = "x"
[working_space]
size_m = [1.0, 1.0, 1.0]
[scene]
kind = "wand"
[cameras]
radius_m = 2.0
height_m = 0.6
[limits]
completeness = 0.9
"""
RIDER = """
[[camera]]
name = "rider"
body = "wand"
size_px = [64, 48]
"""


def scenario(tmp_path: Path, more: str = "", *overrides: str) -> Scenario:
    path = tmp_path / "s.toml"
    path.write_text(BASE + more)
    return load_scenario(path, overrides)


def cameras(tmp_path, more="", *overrides):
    spec = scenario(tmp_path, more, *overrides)
    return {v.camera.name: v for v in virtual_cameras(spec, true_rig(spec, tmp_path))}


def refused(tmp_path, more, *overrides):
    with pytest.raises(InputError) as caught:
        cameras(tmp_path, more, *overrides)
    line = str(caught.value)
    assert "\n" not in line
    return line


# what holds for all, and for one


def test_a_camera_changes_only_what_it_writes(tmp_path):
    made = cameras(
        tmp_path,
        """
[timing]
delay_s = 1e-4
exposure_s = 5e-4
[mount]
vibration_px = 0.2
[errors]
body_px = 0.1
[[camera]]
name = "cam2"
timing.delay_s = 3e-4
mount.vibration_px = 0.0
errors.read_noise_e = 33.0
""",
    )
    assert [v.timing.delay_s for v in made.values()] == [1e-4, 3e-4, 1e-4, 1e-4]
    assert all(v.timing.exposure_s == 5e-4 and v.mount.body_px == 0.1 for v in made.values())
    # a default that is written counts as written
    assert [v.mount.vibration_px for v in made.values()] == [0.2, 0.0, 0.2, 0.2]
    assert [v.sensor.read_noise_e for v in made.values()] == [10.0, 33.0, 10.0, 10.0]


def test_a_clock_fault_adds_to_a_delay(tmp_path):
    made = cameras(
        tmp_path, '[timing]\ndelay_s = 1e-4\n[fault]\nkind = "clock_shift"\ncameras = ["cam3"]\ndelay_s = 0.002\n'
    )
    assert [v.timing.delay_s for v in made.values()] == pytest.approx([1e-4, 1e-4, 2.1e-3, 1e-4])


def test_deliveries_are_by_camera(tmp_path):
    spec = scenario(tmp_path, '[delivery]\ndropped_share = 0.1\n[[camera]]\nname = "cam1"\ndelivery.dies_s = 0.5\n')
    made = deliveries(spec, (v.camera.name for v in virtual_cameras(spec, true_rig(spec, tmp_path))))
    assert {name: d.dropped_share for name, d in made.items()} == dict.fromkeys(made, 0.1)
    assert [made[f"cam{k}"].dies_s for k in (1, 2, 3, 4)] == [0.5, None, None, None]


def test_the_gap_stands_in_for_tilt_and_pupil_only_where_they_are_not_said(tmp_path):
    stress = cameras(tmp_path, "", "model_gap=stress")["cam1"].optics
    assert stress.pupil_shift_m == 0.0005
    said = cameras(tmp_path, "[optics]\npupil_shift_m = 0.0\n", "model_gap=stress")["cam1"].optics
    assert (said.pupil_shift_m, said.tilt_deg, said.gap_px) == (0.0, stress.tilt_deg, stress.gap_px)


def test_optics_know_the_lens_of_a_rig_file(tmp_path):
    (tmp_path / "two.rig").write_text(
        "".join(
            f"""
[[camera]]
name = "{name}"
size = [640, 480]
lens = {{ model = "opencv", fx_px = 500.0, fy_px = 500.0, cx_px = 319.5, cy_px = 239.5 }}
pose = {{ position_m = [{x}, 0.0, -3.0], rotation_wxyz = [1.0, 0.0, 0.0, 0.0] }}
"""
            for name, x in (("a", -0.5), ("b", 0.5))
        )
    )
    optics = cameras(tmp_path, "[optics]\nfocus_m = 2.0\n", 'cameras={rig="two.rig",pixel_pitch_mm=0.005,c_mm=99.0}')[
        "a"
    ].optics
    assert (optics.f_mm, optics.pixel_pitch_mm) == (2.5, 0.005)


# cameras that ride


def test_a_rider_looks_where_it_is_told(tmp_path):
    made = cameras(
        tmp_path,
        RIDER + "fisheye_deg = 190.0\nplace_m = [0.1, 0.0, 0.2]\nforward = [0.0, -2.0, 0.0]\nup = [0.0, 1.0, 3.0]\n",
    )["rider"]
    pose = made.camera.world_from_camera
    # x right, y down, z forward; looking along -y with z up, right is -x
    np.testing.assert_allclose(pose.rotation, [[-1, 0, 0], [0, 0, -1], [0, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(pose.translation, [0.1, 0.0, 0.2])
    assert made.mount.body == "wand"
    # 95 degrees to the right is the image's edge, half a pixel beyond the last centre
    edge = np.array([[np.sin(np.deg2rad(95)), 0.0, np.cos(np.deg2rad(95))]])
    standing = Camera("r", 64, 48, made.camera.lens, Pose(np.eye(3), np.zeros(3)))
    np.testing.assert_allclose(project(standing, edge), [[63.5, 23.5]], atol=1e-9)


def test_a_rider_with_a_named_sensor_has_its_pitch(tmp_path):
    made = cameras(
        tmp_path,
        RIDER.replace("[64, 48]", "[320, 240]")
        + 'c_mm = 1.9\nsensor.name = "ardrone2_vertical"\ntiming.rate_hz = 60.0\n',
    )["rider"]
    assert isinstance(made.camera.lens, MoscaLens)
    assert made.camera.lens.mx_mm_per_px == made.optics.pixel_pitch_mm == 0.006
    assert made.optics.f_mm == 1.9
    assert made.timing.row_time_s == 65e-6


def test_a_rider_reads_a_window_too(tmp_path):
    made = cameras(tmp_path, RIDER + "c_mm = 2.0\nwindow_px = [8, 4, 32, 24]\n")["rider"].camera
    assert (made.width, made.height, made.lens.xp_px, made.lens.yp_px) == (32, 24, 31.5 - 8, 23.5 - 4)


def test_the_pipeline_is_told_of_no_rider(tmp_path):
    spec = scenario(tmp_path, RIDER + "c_mm = 2.0\n")
    made = virtual_cameras(spec, true_rig(spec, tmp_path))
    assert [v.camera.name for v in made] == ["cam1", "cam2", "cam3", "cam4", "rider"]
    assert calibrated(spec, made).rig.names == ("cam1", "cam2", "cam3", "cam4")


def test_riders_change_no_digit_of_what_the_rig_measures(tmp_path):
    from scenarios.run.scenario import run_scenario

    short = ("capture.duration_s=0.05", "scene.turn_deg_per_s=20")
    alone = run_scenario(scenario(tmp_path, "", *short), "x", tmp_path)
    riding = run_scenario(
        scenario(tmp_path, RIDER + "fisheye_deg = 150.0\nforward = [0.0, 0.0, 1.0]\nup = [1.0, 0.0, 0.0]\n", *short),
        "x",
        tmp_path,
    )
    assert len(alone.tracks) > 0
    np.testing.assert_array_equal(alone.tracks.xyz, riding.tracks.xyz)
    assert [m.value for m in alone.record.metrics] == [m.value for m in riding.record.metrics]
    assert alone.record.counts == riding.record.counts


# windows


@pytest.mark.parametrize(
    "lens",
    [
        MoscaLens(7.0, 330.0, 244.0, 0.0099, 0.0099, 0.001, 1e-3),
        OpenCVLens(700.0, 705.0, 330.0, 244.0, 0.1, -0.05),
        FisheyeLens(200.0, 201.0, 330.0, 244.0, -0.01),
    ],
)
def test_a_window_sees_the_same_rays(lens):
    camera = Camera("c", 656, 491, lens, Pose(np.eye(3), np.zeros(3)))
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 1.0], [0.3, 0.2, 2.0], (20, 3))
    part = windowed(camera, (100, 50, 400, 300))
    assert (part.width, part.height) == (400, 300)
    np.testing.assert_allclose(project(part, points), project(camera, points) - [100, 50], atol=1e-9)


@pytest.mark.parametrize(
    "window", ["[0, 0, 657, 10]", "[600, 0, 57, 10]", "[-1, 0, 5, 5]", "[0, 490, 5, 2]", "[0, 0, 0, 9]"]
)
def test_a_window_lies_in_the_image(tmp_path, window):
    line = refused(tmp_path, f'[[camera]]\nname = "cam2"\nwindow_px = {window}\n')
    assert all(part in line for part in ("cam2", window, "656 x 491"))


# cameras by name


def test_a_named_sensor_gives_size_pitch_and_electrons(tmp_path):
    made = cameras(tmp_path, '[sensor]\nname = "sony_imx174"\n[errors]\nread_noise_e = 9.0\n')["cam1"]
    assert (made.camera.width, made.camera.height) == (1936, 1216)
    assert isinstance(made.camera.lens, MoscaLens)
    assert made.camera.lens.mx_mm_per_px == made.optics.pixel_pitch_mm == pytest.approx(0.00586)
    sensor = made.sensor
    assert (sensor.full_well_e, sensor.bits, sensor.quantum_efficiency) == (32691.0, 12, 0.77)
    assert sensor.read_noise_e == 9.0  # given, so not the library's 6.83


def test_a_named_lens_gives_the_principal_distance(tmp_path):
    made = cameras(tmp_path, '[optics]\nlens = "fa_8mm"\n')["cam1"]
    assert isinstance(made.camera.lens, MoscaLens)
    assert (made.camera.lens.c_mm, made.optics.f_mm) == (8.0, 8.0)
    said = cameras(tmp_path, '[optics]\nlens = "fa_8mm"\n', "cameras.c_mm=8.1")["cam1"]
    assert (said.camera.lens.c_mm, said.optics.f_mm) == (8.1, 8.0)


@pytest.mark.parametrize(
    ("more", "parts"),
    [
        ('[sensor]\nname = "sony_imx147"\n', ["sony_imx147", "sony_imx174"]),
        ('[optics]\nlens = "fa_9mm"\n', ["fa_9mm", "fa_8mm"]),
        ('[sensor]\nname = "sony_imx249"\n', ["cam1", "100", "41", "frame_rate_hz"]),
        ('[optics]\nlens = "fa_8mm"\nf_number = 1.4\n', ["f_number", "1.4", "2.4"]),
        ('[optics]\nlens = "fa_8mm"\n[sensor]\nname = "sony_imx174"\n', ["13.4 mm", "9.5 mm", "c_mm"]),
        ('[[camera]]\nname = "cam2"\nsensor.name = "ardrone2_vertical"\n', ["cam2", "656 x 491", "320 x 240"]),
        ("[optics]\nfocus_m = 0.007\n", ["focus_m", "0.007", "0.0075"]),
    ],
)
def test_cameras_that_nobody_sells(tmp_path, more, parts):
    line = refused(tmp_path, more)
    for part in parts:
        assert part in line


def test_a_window_of_a_sensor_is_faster(tmp_path):
    whole = '[sensor]\nname = "sony_imx249"\n'
    # 41 frames/s of 1216 rows are 100 of 498
    small = "".join(f'[[camera]]\nname = "cam{k}"\nwindow_px = [0, 300, 1936, 480]\n' for k in (1, 2, 3, 4))
    assert cameras(tmp_path, whole + small)["cam4"].camera.height == 480


# words that are refused


@pytest.mark.parametrize(
    ("more", "parts"),
    [
        ('[[camera]]\nname = "cam9"\n', ["cam9", "cam1, cam2, cam3, cam4", "body"]),
        ('[[camera]]\nname = "cam1"\n[[camera]]\nname = "cam1"\n', ["cam1", "twice"]),
        ('[[camera]]\nname = "cam1"\nc_mm = 5.0\n', ["cam1", "c_mm", "rides"]),
        (RIDER, ["rider", "wand", "c_mm", "fisheye_deg"]),
        (RIDER + "c_mm = 5.0\nfisheye_deg = 150.0\n", ["rider", "one of"]),
        (RIDER.replace("rider", "cam3") + "c_mm = 5.0\n", ["cam3", "another"]),
        (RIDER + "c_mm = 5.0\nforward = [0.0, 0.0, -1.0]\n", ["rider", "forward", "up", "parallel"]),
        (RIDER + "fisheye_deg = 200.0\n", ["fisheye_deg", "200", "190"]),
        ("[timing]\noffset_s = 0.001\n", ["timing.offset_s", "0.001", "rate_hz"]),
        ("[timing]\nrate_hz = 100.0\nskew_s = 0.001\n", ["timing.skew_s", "offset_s"]),
        ("[timing]\nclock_offset_s = 1.0\n", ["timing.clock_offset_s", "device"]),
        ('[timing]\nclock = "device"\nstamp_jitter_s = 1.0\n', ["timing.stamp_jitter_s", "host"]),
        ('[timing]\nstrobe = "rig"\n', ["timing.strobe", "strobe_s"]),
        ("[mount]\nbump_px = [1.0, 0.0]\n", ["mount.bump_px", "bump_s"]),
        ("[mount]\nbump_s = 1.0\n", ["mount.bump_s", "bump_px"]),
        ("[delivery]\ndies_s = 2.0\nreturns_s = 1.0\n", ["delivery.returns_s", "dies_s"]),
        ("[surroundings.backdrop]\ngradient = [1.5, -1.0]\n", ["gradient", "2"]),
    ],
)
def test_words_that_make_no_sense(tmp_path, more, parts):
    line = refused(tmp_path, more)
    for part in parts:
        assert part in line


def test_a_word_of_one_camera_may_need_one_of_all(tmp_path):
    made = cameras(
        tmp_path,
        """
[mount]
bump_s = 0.5
bump_m = [0.0, 0.0, 0.01]
[[camera]]
name = "cam2"
mount.bump_px = [2.0, 0.0]
""",
    )
    assert [v.mount.bump_px[0] for v in made.values()] == [0.0, 2.0, 0.0, 0.0]


# surroundings


def test_surroundings_are_what_the_scenario_says(tmp_path):
    nothing = surroundings(scenario(tmp_path))
    assert nothing == type(nothing)()
    made = surroundings(
        scenario(
            tmp_path,
            """
[surroundings.context]
ambient = 0.05
[[surroundings.context.clothes]]
pattern = "chest/*"
reflectance = 0.9
[surroundings.ring_light]
strength = 7.0
[[surroundings.spots]]
position_m = [1.0, 2.0, 3.0]
radius_m = 0.01
strength = 2.0
[[surroundings.mirrors]]
center_m = [0.0, 0.0, -1.0]
normal = [0.0, 0.0, 1.0]
x_axis = [1.0, 0.0, 0.0]
size_m = [3.0, 2.0]
[surroundings.glare]
share = 0.02
""",
        )
    )
    assert made.context is not None
    assert made.ring_light is not None
    assert (made.context.ambient, made.context.clothes[0].pattern, made.context.lamp) == (0.05, "chest/*", 0.02)
    assert (made.ring_light.strength, made.spots[0].position_m, made.glare.share) == (7.0, (1.0, 2.0, 3.0), 0.02)
    assert (made.mirrors[0].size_m, made.mirrors[0].reflectance) == ((3.0, 2.0), 0.9)


# the ring


def test_ring_cameras_look_at_the_middle(tmp_path):
    space = scenario(tmp_path).working_space
    rig = ring(Cameras(count=3, radius_m=2.0, height_m=(0.1, 0.6, 1.2)), space)
    for camera in rig.cameras:
        towards = camera.world_from_camera.inverse().transform(np.array([space.center_m]))[0]
        np.testing.assert_allclose(towards[:2], 0.0, atol=1e-12)
        assert towards[2] > 0
        assert camera.world_from_camera.rotation[2, 0] == pytest.approx(0.0)  # the image's rows are level
