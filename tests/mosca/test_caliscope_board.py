"""A real ChArUco session: Caliscope's four webcams (BSD-2), calibrated from its shipped corners alone.

Witnesses: Caliscope's own result on the same corners, and the board's squares of 54 mm. The webcams are not
synchronised (7 ms within a set), which is most of what is left.
"""

import csv
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from mosca.calibration.rigid_target import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.data.files.rig_file import read_rig
from mosca.data.rig import OpenCVLens, Rig
from mosca.data.sightings import Sightings

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
SESSION = DATA / "caliscope_4cam" / "sessions" / "4_cam_recording"
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not SESSION.is_dir(), reason=f"no Caliscope session in {DATA} (set MOSCA_DATA)"),
]
NAMES = ("cam_0", "cam_1", "cam_2", "cam_3")
SIZE = (1280, 720)
CORNER_SIGMA_PX = 0.5


@pytest.fixture(scope="module")
def session() -> tuple[Sightings, np.ndarray]:
    with (SESSION / "calibration" / "extrinsic" / "xy.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    mark = np.array([int(row["keypoint_id"]) for row in rows])
    frames, frame = np.unique([int(row["sync_index"]) for row in rows], return_inverse=True)
    place = {m: (float(r["obj_loc_x"]), float(r["obj_loc_y"]), 0.0) for m, r in zip(mark, rows, strict=True)}
    sightings = Sightings(
        NAMES,
        np.tile(SIZE, (4, 1)),
        len(frames),
        np.array([int(row["cam_id"]) for row in rows]),
        frame,
        mark,
        np.array([(float(row["img_loc_x"]), float(row["img_loc_y"])) for row in rows]),
        np.tile(CORNER_SIGMA_PX**2 * np.eye(2), (len(rows), 1, 1)),
        np.full(len(rows), np.nan),
    )
    return sightings, np.array([place[m] for m in sorted(place)])


def judged(rig: Rig, sightings: Sightings, board: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return reprojection distances [px] and errors of all distances on the board [mm], with OpenCV's functions.

    Corners seen by two cameras or more are triangulated linearly, as SOURCE.md does.
    """
    reprojected, errors = [], []
    for frame in range(sightings.frames):
        marks, points = [], []
        for mark in range(len(board)):
            here = np.flatnonzero((sightings.frame == frame) & (sightings.mark == mark))
            if len(here) < 2:
                continue
            rows, parts = [], []
            for k in here:
                camera = rig.cameras[sightings.camera[k]]
                lens, pose = camera.lens, camera.world_from_camera.inverse()
                assert isinstance(lens, OpenCVLens)
                matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
                bent = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
                x, y = cv2.undistortPoints(sightings.xy_px[k][None, None], matrix, bent)[0, 0]
                across = np.column_stack([pose.rotation, pose.translation])
                rows += [x * across[2] - across[0], y * across[2] - across[1]]
                parts.append((cv2.Rodrigues(np.array(pose.rotation))[0], pose.translation, matrix, bent))
            point = np.linalg.svd(rows)[2][-1]
            marks.append(mark)
            points.append(point[:3] / point[3])
            for k, part in zip(here, parts, strict=True):
                again = cv2.projectPoints(points[-1][None], *part)[0][0, 0]
                reprojected.append(np.hypot(*(again - sightings.xy_px[k])))
        if len(marks) > 1:
            first, second = np.triu_indices(len(marks), 1)
            at, true = np.array(points), board[marks]
            measured = np.linalg.norm(at[first] - at[second], axis=1)
            errors.append(1000 * (measured - np.linalg.norm(true[first] - true[second], axis=1)))
    return np.array(reprojected), np.concatenate(errors)


def test_from_the_corners_alone_at_least_as_good_as_caliscope(session):
    sightings, board = session
    # four webcams that are not synchronised (frames of a set lie up to 33 ms apart): what moves whole images is the
    # board between their exposures, no shake of the cameras
    settings = RigidSettings(LensChoice("opencv"), steady=False)
    found = calibrate_rigid(sightings, RigidTarget("ChArUco board", board), settings)
    reprojected, error_mm = judged(found.rig, sightings, board)
    shipped = judged(read_rig(SESSION / "camera_array.toml"), sightings, board)
    for name, (pixels, lengths) in (("ours", (reprojected, error_mm)), ("shipped", shipped)):
        print(
            f"{name}: reprojection median {np.median(pixels):.3f} px, board distances median "
            f"{np.median(np.abs(lengths)):.3f} mm, rms {np.sqrt(np.mean(lengths**2)):.3f} mm"
        )
    assert np.median(reprojected) <= 0.46
    assert np.median(np.abs(error_mm)) <= 0.44
    assert np.sqrt(np.mean(error_mm**2)) <= 0.81
