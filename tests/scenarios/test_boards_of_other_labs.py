"""Board videos of other labs calibrated by ``mosca calibrate`` as they are, judged with OpenCV's functions.

sleap-anipose: four cameras with wide lenses, a folder each. Its board is not flat: each camera alone, by
``cv2.calibrateCameraRO``, has the same corner 1 mm above the plane. OpenCV's own calibration takes it for flat and
leaves 0.22 to 0.47 px.
Caliscope: an inverted board whose mirror image is seen from behind, by webcams that are not synchronised.
"""

import csv
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import mosca

from mosca.data.files.rig_file import read_rig

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
SLEAP, CALISCOPE = DATA / "sleap_anipose", DATA / "caliscope_4cam" / "sessions" / "4_cam_recording"
pytestmark = [
    pytest.mark.data,
    pytest.mark.slow,
    pytest.mark.skipif(
        not (SLEAP.is_dir() and CALISCOPE.is_dir()), reason=f"no sleap_anipose or caliscope_4cam in {DATA}"
    ),
]
WORSE = 1.2
"""Errors of lengths with the rig found, over those with Caliscope's own."""


def calibrated(folder, source, target, *options):
    (folder / "board.toml").write_text(target)
    done = mosca("calibrate", source, "--target", "board.toml", "--out", "rig.toml", *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    return read_rig(folder / "rig.toml"), done.stdout


def opencv_views(path, board):
    """Return OpenCV's corners (n, 2) [px] and their places on its board (n, 3) [m] of each image."""
    detector, video = cv2.aruco.CharucoDetector(board), cv2.VideoCapture(str(path))
    views = []
    while True:
        read, image = video.read()
        if not read:
            return views
        corners, ids, _, _ = detector.detectBoard(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
        views.append((board.getChessboardCorners()[ids.ravel()], corners.reshape(-1, 2)))


def seen_by(camera, xy):
    """Return two rows of a linear triangulation (2, 4) from an image point (2,), by OpenCV."""
    matrix, bend = opencv_lens(camera)
    x, y = cv2.undistortPoints(np.array([[xy]], dtype=float), matrix, bend)[0, 0]
    pose = camera.world_from_camera.inverse()
    across = np.column_stack([pose.rotation, pose.translation])
    return [x * across[2] - across[0], y * across[2] - across[1]]


def opencv_lens(camera):
    """Return a camera's matrix (3, 3) and distortion (5,) as OpenCV takes them."""
    lens = camera.lens
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    return matrix, np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])


def poses_of(views, camera):
    """Return the pose of each view [m] by ``cv2.solvePnP``."""
    found = [cv2.solvePnP(*view, *opencv_lens(camera)) for view in views]
    return [(cv2.Rodrigues(turn)[0], shift[:, 0]) for _, turn, shift in found]


def reprojected(rig, every):
    """Return for each camera how far (n, 2) [px] OpenCV's corners are from where three cameras or more have them.

    ``every``: views by camera. Nothing is assumed of the board.
    """
    rays: dict = {}
    for name, views in every.items():
        for frame, (places, corners) in enumerate(views):
            for place, xy in zip(places, corners, strict=True):
                rays.setdefault((frame, tuple(place.round(6))), {})[name] = xy
    off: dict = {name: [] for name in every}
    for seen in rays.values():
        if len(seen) < 3:
            continue
        point = np.linalg.svd(np.vstack([seen_by(rig.camera(name), xy) for name, xy in seen.items()]))[2][-1]
        for name, xy in seen.items():
            pose = rig.camera(name).world_from_camera.inverse()
            turn = cv2.Rodrigues(np.array(pose.rotation))[0]
            at = (point[:3] / point[3])[None]
            again = cv2.projectPoints(at, turn, pose.translation, *opencv_lens(rig.camera(name)))[0][0, 0]
            off[name].append(again - xy)
    return {name: np.array(errors) for name, errors in off.items()}


def test_four_wide_lenses_of_sleap_anipose(tmp_path):
    target = 'kind = "board"\ncolumns = 8\nrows = 11\nsquare_m = 0.024\nmarker_m = 0.01875\n'
    rig, said = calibrated(tmp_path, SLEAP, target + 'dictionary = "DICT_4X4_1000"\n', "--lens", "opencv")
    assert "REFUSED" not in said
    assert rig.names == ("back", "mid", "side", "top")
    left = [float(one) for one in re.findall(r"sigma_[xy] ([0-9.]+) px", said)]
    print("reprojection", left)
    assert len(left) == 8
    assert max(left) <= 0.1
    board = cv2.aruco.CharucoBoard(
        (8, 11), 0.024, 0.01875, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    )
    views = {name: opencv_views(next((SLEAP / name).glob("*/*.MOV")), board) for name in rig.names}
    off = reprojected(rig, views)
    for name, one in views.items():
        places, corners = ([view[k] for view in one] for k in (0, 1))
        alone, *_ = cv2.calibrateCamera(places, corners, (1280, 1024), None, None)
        usual = 1.4826 * np.median(np.abs(off[name]))  # of a coordinate; OpenCV's corners have outliers
        print(f"{name}: OpenCV's corners {usual:.3f} px, OpenCV's calibration with a flat board {alone:.3f} px")
        assert usual < 0.13
    poses = {name: poses_of(views[name], rig.camera(name)) for name in rig.names}
    # "side" has a pose of its own: from the board's poses before it and before each other camera, view by view
    for name in ("back", "mid", "top"):
        apart = [
            np.linalg.norm(turn_s.T @ shift_s - turn_o.T @ shift_o)
            for (turn_s, shift_s), (turn_o, shift_o) in zip(poses["side"], poses[name], strict=True)
        ]
        side, other = (rig.camera(one).world_from_camera.translation for one in ("side", name))
        assert np.linalg.norm(side - other) == pytest.approx(np.median(apart), rel=0.02)
        assert np.linalg.norm(side - other) > 0.1


def test_four_webcams_and_the_inverted_board_of_caliscope(tmp_path):
    target = 'kind = "board"\ncolumns = 4\nrows = 5\nsquare_m = 0.054\nmarker_m = 0.0405\ninverted = true\n'
    target += 'from_behind = true\ndictionary = "DICT_4X4_1000"\n'
    rig, said = calibrated(tmp_path, CALISCOPE / "calibration" / "extrinsic", target, "--lens", "opencv")
    assert "REFUSED" not in said
    with (CALISCOPE / "calibration" / "extrinsic" / "xy.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    shipped = read_rig(CALISCOPE / "camera_array.toml")
    found, theirs = (board_errors_mm(one, rows) for one in (rig, shipped))
    print(
        f"distances on the board, median: {np.median(found):.3f} mm, with the shipped cameras {np.median(theirs):.3f}"
    )
    assert len(found) > 3000
    assert np.median(found) < WORSE * np.median(theirs)


def board_errors_mm(rig, rows):
    """Return how far distances on the board are off, from Caliscope's own corners, triangulated by OpenCV."""
    rays: dict = {}
    for row in rows:
        xy = float(row["img_loc_x"]), float(row["img_loc_y"])
        place = float(row["obj_loc_x"]), float(row["obj_loc_y"])
        lines = rays.setdefault(int(row["sync_index"]), {}).setdefault(place, [])
        lines.extend(seen_by(rig.camera(f"cam_{row['cam_id']}"), xy))
    errors = []
    for marks in rays.values():
        points = {place: np.linalg.svd(lines)[2][-1] for place, lines in marks.items() if len(lines) > 2}
        at = np.array([point[:3] / point[3] for point in points.values()]).reshape(-1, 3)
        true = np.array(list(points)).reshape(-1, 2)
        first, second = np.triu_indices(len(at), 1)
        measured = np.linalg.norm(at[first] - at[second], axis=1)
        errors.append(1000 * np.abs(measured - np.linalg.norm(true[first] - true[second], axis=1)))
    return np.concatenate(errors)
