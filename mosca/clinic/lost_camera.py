"""Pose of a camera whose rays meet no others: estimated from the curves that markers draw, without labels."""

import cv2
import numpy as np

from mosca.camera.projection import lens_directions
from mosca.clinic.causes import Diagnosis
from mosca.clinic.observations import PointImages
from mosca.data.arrays import Array
from mosca.data.detections import Seen
from mosca.data.rig import Camera, Pose, Rig

LOST_SHARE = 0.5
"""A camera is lost if less than this share of its detections belongs to points."""
LEAST_FRAMES = 30
"""Fewest frames of a curve from which a pose is estimated."""
FITS_PX = 2.0
"""Largest median distance of a camera's images from the points' projections at the estimated pose [px]."""
LARGE_DEG = 10.0
"""Rotation beyond which the pose is no small move of the mount."""
SAME_PLACE = 0.1
"""A mirrored pose keeps the target's middle at the same place before the camera, to this share of the distance."""


def lost_cameras(seen: list[Seen], rig: Rig, observed: PointImages) -> list[Diagnosis]:
    """Return a diagnosis of each lost camera whose true pose can be estimated."""
    found = []
    for k, camera in enumerate(rig.cameras):
        others = np.delete(observed.connected, k)
        if observed.connected[k] >= LOST_SHARE or len(others) < 2 or np.median(others) < LOST_SHARE:
            continue
        # with reflections, too, detections belong to no point, but each point has its image where it is expected
        if _misfit(camera, camera.world_from_camera, seen, observed) * _focal_px(camera) < FITS_PX:
            continue
        pose, median_px = _found_pose(seen, camera, observed)
        if pose is None:
            continue
        found.append(_diagnosis(camera, pose, median_px, observed, float(observed.connected[k])))
    return found


def _diagnosis(camera: Camera, pose: Pose, median_px: float, observed: PointImages, share: float) -> Diagnosis:
    believed = camera.world_from_camera
    turn = believed.rotation.T @ pose.rotation
    angle = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    middle = observed.xyz.mean(axis=0)
    there, here = pose.inverse().transform(middle[None])[0], believed.inverse().transform(middle[None])[0]
    away = float(np.linalg.norm(there - here) / np.linalg.norm(there))
    # the rotation made by two reflections has its axis across the line of sight
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    across = abs(float(axis @ there)) / max(float(np.linalg.norm(axis) * np.linalg.norm(there)), 1e-12)
    code = "mirrored-pose" if angle > LARGE_DEG and away < SAME_PLACE and across < 0.2 else "camera-moved"
    text = (
        f"camera '{camera.name}': {100 * share:.0f} % of its detections meet other cameras' rays; from the markers' "
        f"curves it stands {np.linalg.norm(pose.translation - believed.translation):.2f} m and {angle:.1f} deg from "
        f"where the rig file has it (median {median_px:.2f} px)"
    )
    more = (
        f"the middle of the volume lies at the same place before both, to {100 * away:.1f} %: two poses of one view "
        "of a plane"
    )
    evidence = (text, more) if code == "mirrored-pose" else (text,)
    figures = {"turn_deg": angle, "connected": share}
    return Diagnosis(code, 1e-12, evidence, 1.0, -1e9, camera.name, figures)


def _found_pose(seen: list[Seen], camera: Camera, observed: PointImages) -> tuple[Pose | None, float]:
    """Return the pose at which a camera's curves fit those of the points, and the median misfit [px]."""
    curves = _curves([(s.pulse, d[camera.name].xy_px) for s, d, _ in seen if camera.name in d])
    names, counts = np.unique(observed.track, return_counts=True)
    tracks = {}
    for name in names[np.argsort(-counts)][:12]:
        rows = observed.track == name
        tracks[int(name)] = dict(zip(observed.frame[rows].tolist(), observed.xyz[rows], strict=True))
    focal = _focal_px(camera)
    best: tuple[float, Pose | None, float] = (np.inf, None, np.inf)
    for curve in sorted(curves, key=len, reverse=True)[:12]:
        for track in tracks.values():
            common = sorted(set(curve) & set(track))
            if len(common) < LEAST_FRAMES:
                continue
            pick = [common[i] for i in np.linspace(0, len(common) - 1, 24).round().astype(int)]
            pose = _pose_of(camera, np.array([track[f] for f in pick]), np.array([curve[f] for f in pick]))
            if pose is None:
                continue
            miss = _misfit(camera, pose, seen, observed) * focal
            if miss < best[0]:
                best = (miss, pose, miss)
    return (best[1], best[2]) if best[0] < FITS_PX else (None, best[2])


def _pose_of(camera: Camera, points: Array, xy: Array) -> Pose | None:
    rays = lens_directions(camera.lens, xy)
    plane = rays[:, :2] / rays[:, 2:]
    ok, turn, shift = cv2.solvePnP(points, plane, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    if not ok:
        return None
    rotation, _ = cv2.Rodrigues(turn)
    inside = points @ rotation.T + shift.ravel()
    if (inside[:, 2] <= 0).any():
        return None
    if np.median(np.linalg.norm(inside[:, :2] / inside[:, 2:] - plane, axis=1)) * _focal_px(camera) > FITS_PX:
        return None
    return Pose(rotation.T, -rotation.T @ shift.ravel())


def _misfit(camera: Camera, pose: Pose, seen: list[Seen], observed: PointImages) -> float:
    """Return the median distance of the points' directions from those of the nearest detections, as tangents."""
    misses: list[float] = []
    for frame_set, detections, _ in seen[:: max(1, len(seen) // 20)]:
        points = observed.xyz[observed.frame == frame_set.pulse]
        if camera.name not in detections or not len(points) or not len(detections[camera.name]):
            continue
        rays = lens_directions(camera.lens, detections[camera.name].xy_px)
        inside = pose.inverse().transform(points)
        inside = inside[inside[:, 2] > 0]
        away = np.linalg.norm((inside[:, :2] / inside[:, 2:])[:, None] - (rays[:, :2] / rays[:, 2:])[None], axis=2)
        misses += away.min(axis=1).tolist() if len(inside) else []
    return float(np.median(misses)) if misses else float("inf")


def _curves(images: list[tuple[int, Array]]) -> list[dict[int, Array]]:
    """Return curves (frame -> place) of a camera's detections that are mutually nearest in successive frames."""
    curves: list[dict[int, Array]] = []
    open_: list[tuple[dict[int, Array], int]] = []
    for frame, xy in images:
        fresh = []
        ends = np.array([curve[last] for curve, last in open_]).reshape(-1, 2)
        taken = set()
        if len(ends) and len(xy):
            away = np.linalg.norm(ends[:, None] - xy[None], axis=2)
            for i, j in enumerate(away.argmin(axis=1)):
                others = np.delete(away[i], j)
                if away[:, j].argmin() == i and (not len(others) or away[i, j] < 0.3 * others.min()):
                    open_[i][0][frame] = xy[j]
                    fresh.append((open_[i][0], frame))
                    taken.add(int(j))
        for j in set(range(len(xy))) - taken:
            curve = {frame: xy[j]}
            curves.append(curve)
            fresh.append((curve, frame))
        open_ = fresh
    return [curve for curve in curves if len(curve) >= LEAST_FRAMES]


def _focal_px(camera: Camera) -> float:
    rays = lens_directions(
        camera.lens, np.array([[camera.width / 2, camera.height / 2], [camera.width / 2 + 1, camera.height / 2]])
    )
    return 1.0 / max(float(np.linalg.norm(rays[1, :2] / rays[1, 2] - rays[0, :2] / rays[0, 2])), 1e-12)
