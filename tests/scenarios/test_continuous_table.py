"""``mosca reconstruct TABLE.csv --continuous``: image points that others detected, with names and without.

Points on sums of sinusoids are projected by the pinhole equations and written as a table; each camera exposes at
instants of its own.
"""

import csv
import json

import numpy as np
import pytest
from command_line import mosca

from mosca.data.files.rig_file import write_rig
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.formats.tracks.tracks_csv import read_tracks_csv

WIDTH, HEIGHT, FOCAL, RATE_HZ, SECONDS, SIGMA_PX = 640, 480, 600.0, 30.0, 3.0, 0.1
PLACES = ((-0.9, 0.1, 0.0), (0.05, -0.4, 0.2), (0.8, 0.3, 0.1))
LATE_S = (0.0, 0.011, 0.023)
"""When each camera took its first frame."""
NAMES = tuple(f"p{k}" for k in range(8))


def motion(time_s: np.ndarray) -> np.ndarray:
    """Return (t, points, 3) [m]."""
    rng = np.random.default_rng(4)
    middle = rng.uniform((-0.4, -0.3, 1.8), (0.4, 0.3, 2.4), (len(NAMES), 3))
    phase, size = rng.uniform(0, 6, (2, len(NAMES), 3)), rng.uniform(0.03, 0.06, (2, len(NAMES), 3))
    waves = [
        s * np.sin(f * np.asarray(time_s)[:, None, None] + p) for f, s, p in zip((5, 9), size, phase, strict=True)
    ]
    return middle + sum(waves)


def rig() -> Rig:
    lens = OpenCVLens(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    cameras = []
    for k, place in enumerate(PLACES):
        ahead = np.array([0.0, 0.0, 2.1]) - place
        ahead /= np.linalg.norm(ahead)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        turn = np.column_stack([right, np.cross(ahead, right), ahead])
        cameras.append(Camera(f"cam{k}", WIDTH, HEIGHT, lens, Pose(turn, np.array(place))))
    return Rig(tuple(cameras))


def table(path, named, late_s=LATE_S, stamped_s=LATE_S, by_frame=False, sigma=True):
    """Write the table: exposures at ``late_s`` + k / rate, stamped ``stamped_s`` + k / rate."""
    rng = np.random.default_rng(7)
    rows = []
    for camera, late, stamped in zip(rig().cameras, late_s, stamped_s, strict=True):
        for k in range(round(SECONDS * RATE_HZ)):
            away = motion(np.array([late + k / RATE_HZ]))[0] - camera.world_from_camera.translation
            v = away @ camera.world_from_camera.rotation
            xy = FOCAL * v[:, :2] / v[:, 2:] + [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]
            xy += rng.normal(0, SIGMA_PX, xy.shape)
            for p in rng.permutation(len(NAMES)):
                row = {"camera": camera.name, "x_px": xy[p, 0], "y_px": xy[p, 1]}
                row |= {"frame": k} if by_frame else {"time_s": stamped + k / RATE_HZ}
                row |= {"sigma_px": SIGMA_PX} if sigma else {}
                row |= {"point": NAMES[p]} if named else {}
                rows.append(row)
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def run(tmp_path, *options):
    write_rig(rig(), tmp_path / "rig.toml")
    out = tmp_path / "tracks.csv"
    done = mosca(
        "reconstruct", str(tmp_path / "points.csv"), "--rig", str(tmp_path / "rig.toml"), "--out", str(out),
        "--continuous", *options, cwd=tmp_path
    )  # fmt: skip
    return done, out


def off_m(out):
    """Distances (n,) of the measured samples from the nearest point's true position."""
    tracks = read_tracks_csv(out)
    tracks = tracks.select(tracks.status == "measured")
    true = motion(tracks.time_ns * 1e-9)
    return np.linalg.norm(true - tracks.xyz[:, None], axis=2).min(axis=1), tracks


@pytest.mark.parametrize("named", [True, False])
def test_a_table_of_image_points_becomes_tracks(tmp_path, named):
    table(tmp_path / "points.csv", named)
    done, out = run(tmp_path, "--clocks", "common")
    assert done.returncode == 0, done.stderr
    away, tracks = off_m(out)
    assert len(np.unique(tracks.track)) == len(NAMES)
    assert len(tracks) > 0.97 * len(NAMES) * SECONDS * RATE_HZ
    # 0.1 px at 2 m and 600 px: 0.33 mm an axis and image, less by what a curve averages, more along the view
    assert np.sqrt(np.mean(away**2)) < 0.6e-3
    if named:
        true = motion(tracks.time_ns * 1e-9)
        column = [NAMES.index(name) for name in tracks.label.tolist()]
        assert np.linalg.norm(true[np.arange(len(tracks)), column] - tracks.xyz, axis=1).max() < 5e-3


@pytest.mark.parametrize("named", [pytest.param(True, marks=pytest.mark.slow), False])
def test_cameras_of_a_table_that_were_started_apart_are_tied(tmp_path, named):
    """Frame numbers only: every camera counts from its own first frame."""
    table(tmp_path / "points.csv", named, late_s=(0.0, 0.111, 0.223), by_frame=True)
    done, out = run(tmp_path, "--clocks", "own", "--search", "0.5", "--fps", "30")
    assert done.returncode == 0, done.stderr
    clocks = json.loads(out.with_suffix(".clocks.json").read_text(encoding="utf-8"))["clocks"]
    # 0.01 frame
    assert clocks["cam1"]["offset_s"] == pytest.approx(0.111, abs=0.01 / RATE_HZ)
    assert clocks["cam2"]["offset_s"] == pytest.approx(0.223, abs=0.01 / RATE_HZ)
    assert np.sqrt(np.mean(off_m(out)[0] ** 2)) < 0.8e-3


def test_taken_for_one_clock_they_do_not_fit(tmp_path):
    """The control: the same stamps, believed."""
    table(tmp_path / "points.csv", True, late_s=(0.0, 0.111, 0.223), by_frame=True)
    done, out = run(tmp_path, "--clocks", "common", "--fps", "30")
    assert done.returncode == 0, done.stderr
    assert np.sqrt(np.mean(off_m(out)[0] ** 2)) > 5e-3


def test_without_a_stated_error_it_is_learned(tmp_path):
    table(tmp_path / "points.csv", True, sigma=False)
    done, out = run(tmp_path, "--clocks", "common")
    assert done.returncode == 0, done.stderr
    away, tracks = off_m(out)
    three_sigma2 = np.einsum("nii->n", tracks.covariance)
    assert 0.4 < np.mean(away**2) / np.mean(three_sigma2) < 1.6


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda t: t.replace("x_px", "x"), "lacks the column 'x_px'"),
        (lambda t: t.replace("time_s", "time"), "neither 'time_s' nor 'frame'"),
        (lambda t: t.replace("time_s", "frame").replace(".0", ""), "give the frame rate, for example --fps 30"),
        (lambda t: t.replace("cam2", "left"), "camera 'left' is not in the rig, which has cam0, cam1, cam2"),
        (lambda t: t.replace("0.0,0.1,p0", "0.0,-0.1,p0"), "sigma_px = -0.1; above 0 px is allowed"),
        (lambda t: t.replace("0.0,0.1,p0", "0.0,0.1,"), "point is empty, others have names"),
        (lambda t: t.replace("0.0,0.1,p0", "0.0,0.1,p1"), "point 'p1' is twice in this frame of 'cam0'"),
        (lambda t: "\n".join(t.splitlines()[:40]), "camera 'cam0' has 5 frames with points, 8 are needed")
    ]
)  # fmt: skip
def test_tables_that_cannot_be_used_are_told_in_a_line(tmp_path, change, told):
    path = table(tmp_path / "points.csv", True)
    path.write_text(change(path.read_text(encoding="utf-8")), encoding="utf-8")
    done, _out = run(tmp_path, "--clocks", "common")
    assert done.returncode == 2
    assert told in done.stderr
    assert str(path) in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
