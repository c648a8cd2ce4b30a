"""``mosca reconstruct --continuous``: free-running cameras to tracks, and error messages.

The images are drawn here: three pinhole cameras with axes along z, Gaussian spots, each camera at its own instants.
"""

import json
import re

import cv2
import numpy as np
import pytest
from command_line import mosca

from mosca.data.files.rig_file import write_rig
from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.formats.tracks.tracks_csv import read_tracks_csv
from mosca.recording import RecordingWriter

WIDTH, HEIGHT, FOCAL, RATE_HZ = 160, 120, 300.0, 50.0
PLACES = {"left": (-0.3, 0.0, 0.0), "middle": (0.0, 0.2, 0.0), "right": (0.3, 0.0, 0.0)}
LATE_NS = {"left": 0, "middle": 7_000_000, "right": 13_000_000}
FRAMES = 25
SETTINGS = ("--set", "match.worst_sigma_m=0.05", "--set", "match.judge_sizes=false")


def places(time_s: float) -> np.ndarray:
    """Return where the three spots are (3, 3) [m]."""
    angle = 2 * np.pi * 0.8 * time_s + np.array([0.0, 2.1, 4.2])
    x, y = 0.22 * np.cos(angle), 0.15 * np.sin(angle)
    return np.column_stack([x, y, 2.0 + 0.1 * np.sin(angle + [0.0, 1.0, 2.0])])


def picture(place: tuple[float, float, float], time_s: float) -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    image = np.full((HEIGHT, WIDTH), 5.0)
    for x, y, z in places(time_s) - place:
        u, v = ((WIDTH - 1) / 2 + FOCAL * x / z - shift(place)[0], (HEIGHT - 1) / 2 + FOCAL * y / z - shift(place)[1])
        image += 180 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 1.3**2))
    return np.rint(image.clip(0, 255)).astype(np.uint8)


def shift(place: tuple[float, float, float]) -> tuple[float, float]:
    """Principal points are moved so that the middle of the scene, 2 m away, is in the middle of each image."""
    return -FOCAL * place[0] / 2.0, -FOCAL * place[1] / 2.0


def rig(turned: str = "") -> Rig:
    back = np.diag([-1.0, 1.0, -1.0])
    cameras = []
    for name, place in PLACES.items():
        right, down = shift(place)
        lens = OpenCVLens(FOCAL, FOCAL, (WIDTH - 1) / 2 - right, (HEIGHT - 1) / 2 - down)
        turn = back if name == turned else np.eye(3)
        cameras.append(Camera(name, WIDTH, HEIGHT, lens, Pose(turn, np.array(place))))
    return Rig(tuple(cameras))


def stamps(name: str) -> list[int]:
    return [LATE_NS[name] + round(k * 1e9 / RATE_HZ) for k in range(FRAMES)]


def record(folder, given: dict[str, list[int]], turned: str = "") -> None:
    write_rig(rig(turned), folder / "rig.toml")
    infos = [CameraInfo(name, WIDTH, HEIGHT, 8, RATE_HZ, "session", "exposure_middle") for name in PLACES]
    frames = [
        (stamp, Frame(name, k, given[name][k], 0, picture(PLACES[name], stamp * 1e-9), stamp_event="exposure_middle"))
        for name in PLACES
        for k, stamp in enumerate(stamps(name)[: len(given[name])])
    ]
    with RecordingWriter(folder / "take", infos) as writer:
        for _stamp, frame in sorted(frames, key=lambda one: one[0]):
            writer.write(frame)


def run(folder, *more: str) -> tuple[int, str, str]:
    done = mosca(
        "reconstruct", "take", "--rig", "rig.toml", "--out", "t.csv", "--continuous", *SETTINGS, *more, cwd=folder
    )
    return done.returncode, done.stdout, done.stderr


def test_tracks_at_a_rate_of_choice_and_clocks_beside_them(tmp_path):
    record(tmp_path, {name: stamps(name) for name in PLACES})
    code, out, err = run(tmp_path, "--rate", "125")
    assert code == 0, err
    tracks = read_tracks_csv(tmp_path / "t.csv")
    assert "75 frames of 3 cameras, each at its own instant" in out
    assert len(np.unique(tracks.track)) == 3
    np.testing.assert_array_equal(np.unique(np.diff(np.unique(tracks.time_ns))), [8_000_000])
    for time_ns, xyz in zip(tracks.time_ns, tracks.xyz, strict=True):
        # a spot of 1.3 px is measured to some 0.05 px: 0.3 mm across, some mm along the line of sight
        assert np.linalg.norm(places(time_ns * 1e-9) - xyz, axis=1).min() < 0.008
    clocks = json.loads((tmp_path / "t.clocks.json").read_text())["clocks"]
    assert set(clocks) == set(PLACES)
    assert {"offset_s", "offset_sigma_s", "drift_ppm", "drift_sigma_ppm"} <= set(clocks["left"])


def one_line(err: str) -> str:
    assert err.count("\n") == 1, err
    return err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda s: s[:5] + [s[4]] + s[6:], "frames 4 and 5 have the same time stamp"),
        (lambda s: [s[1], s[0], *s[2:]], "frame 1 is stamped 20 ms before frame 0"),
        (lambda s: s[:3], "camera 'middle': 3 usable frames given, 8 are needed"),
        (lambda s: [t + 50_000_000_000 for t in s], "camera 'middle': filmed from 50.0.* at no time together"),
    ],
    ids=["equal", "unsorted", "short", "apart"],
)
def test_stamps_that_cannot_be_used_are_told_in_one_line(tmp_path, change, told):
    given = {name: stamps(name) for name in PLACES}
    given["middle"] = change(given["middle"])
    record(tmp_path, given)
    code, _out, err = run(tmp_path)
    assert code == 2
    assert re.search(told, one_line(err))


def test_a_camera_that_looks_elsewhere_is_told_in_one_line(tmp_path):
    record(tmp_path, {name: stamps(name) for name in PLACES}, turned="right")
    code, _out, err = run(tmp_path)
    assert code == 2
    assert "camera 'right' sees nothing that another camera sees" in one_line(err)


def pictures(folder) -> None:
    """A folder of numbered images per camera, without time stamps."""
    write_rig(rig(), folder / "rig.toml")
    for name, place in PLACES.items():
        (folder / "take" / name).mkdir(parents=True)
        for k in range(12):
            cv2.imwrite(str(folder / "take" / name / f"{k:06d}.png"), picture(place, k / RATE_HZ))


def test_images_without_stamps_want_a_rate_in_one_line(tmp_path):
    pictures(tmp_path)
    code, _out, err = run(tmp_path)
    assert code == 2
    assert "no frames.csv says when its frames were taken; pass --fps" in one_line(err)


def test_images_without_stamps_are_taken_for_common_and_it_is_said(tmp_path):
    pictures(tmp_path)
    code, out, err = run(tmp_path, "--fps", f"{RATE_HZ:g}")
    assert code == 0, err
    assert "no frames.csv gives stamps: frames are taken to be 1/50 s apart" in out
