"""OpenPTV (``optv``): target recognition, epipolar correspondences and point positions, in millimetres.

Its lens model measures distortion from the middle of the image and cannot express OpenCV's. Therefore distortion is
removed from image positions first (Newton's method), and OpenPTV gets a pinhole camera. It takes at most four
cameras. Of more cameras on a ring, four are used of which no two face each other: its points are means over pairs of
cameras, and a pair that sees a marker along nearly the same line gives no point. Its epipolar lines run between two
planes of constant z, so that a ray must cross these at an angle: the world is rotated until z is as near to all lines
of sight as possible. Points outside the volume are left out.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from contract import Dataset, run, write_detections, write_points
from optv.calibration import Calibration
from optv.correspondences import MatchedCoords, correspondences
from optv.image_processing import preprocess_image
from optv.orientation import point_positions
from optv.parameters import ControlParams, TargetParams, VolumeParams
from optv.segmentation import target_recognition
from optv.tracking_framebuf import TargetArray
from optv.transforms import convert_arr_pixel_to_metric
from PIL import Image

MOST_CAMERAS = 4
PITCH_MM = 0.01
TRIED_AXES = 2000
GLASS_MM = 10.0
"""Distance from the camera to the glass in OpenPTV's model."""
STEPS = 8
PLACES = (0.0, 0.125, 0.375, 0.75)
"""Positions of the four cameras in the list of a larger ring, as shares of its length."""


def straightened(places: Any, matrix: Any, coefficients: Any) -> Any:
    """Return image positions (n, 2) [px] of a camera without distortion."""
    k1, k2, p1, p2, k3 = coefficients
    goal = (places - (matrix[0, 2], matrix[1, 2])) / (matrix[0, 0], matrix[1, 1])
    at = goal.copy()

    def bent(xy: Any) -> Any:
        x, y = xy.T
        r = x * x + y * y
        radial = 1 + r * (k1 + r * (k2 + r * k3))
        return np.column_stack(
            [x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x), y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y]
        )

    for _ in range(STEPS):
        step = 1e-7
        miss = goal - bent(at)
        jx, jy = (bent(at + (step, 0)) - bent(at)) / step, (bent(at + (0, step)) - bent(at)) / step
        determinant = jx[:, 0] * jy[:, 1] - jy[:, 0] * jx[:, 1]
        at = at + np.column_stack(
            [
                (jy[:, 1] * miss[:, 0] - jy[:, 0] * miss[:, 1]) / determinant,
                (jx[:, 0] * miss[:, 1] - jx[:, 1] * miss[:, 0]) / determinant,
            ]
        )
    return at * (matrix[0, 0], matrix[1, 1]) + (matrix[0, 2], matrix[1, 2])


def turned(forward: list[Any]) -> Any:
    """Return the rotation (3, 3) into a world whose z has the largest least angle to the planes across the lines of
    sight.
    """
    looks = np.array(forward)
    k = np.arange(TRIED_AXES) + 0.5
    height, around = 1 - 2 * k / TRIED_AXES, np.pi * (1 + 5**0.5) * k
    axes = np.column_stack([np.sqrt(1 - height**2) * np.cos(around), np.sqrt(1 - height**2) * np.sin(around), height])
    z = axes[np.argmax(np.abs(axes @ looks.T).min(axis=1))]
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


class OpenPTVRig:
    """The cameras for OpenPTV, and its parameters."""

    def __init__(self, dataset: Dataset, settings: dict[str, Any]) -> None:
        count = len(dataset.names)
        most = min(count, MOST_CAMERAS)
        self.used = [int(share * count) for share in PLACES] if count > MOST_CAMERAS else list(range(count))
        one = dataset.cameras[0]
        self.size = one["width"], one["height"]
        self.control = ControlParams(most, image_size=self.size, pixel_size=(PITCH_MM, PITCH_MM), flags=["hp"])
        media = self.control.get_multimedia_params()
        media.set_n1(1.0)
        media.set_layers([1.0], [1.0])
        media.set_n3(1.0)
        given = list(dataset.matrices())
        self.turn = turned([given[k][2][2] for k in self.used])
        self.given = [(given[k][0], given[k][1], given[k][2] @ self.turn.T, given[k][3]) for k in self.used]
        self.calibrations = [self._calibration(*self.given[k]) for k in range(most)]
        self.volume_m = dataset.about["volume_m"]
        edges = np.array(self.volume_m)
        corners = np.array([[edges[i, 0], edges[j, 1], edges[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        corners = 1000 * corners @ self.turn.T
        (x0, _, z0), (x1, _, z1) = corners.min(axis=0), corners.max(axis=0)
        self.volume = VolumeParams(
            x_span=(x0, x1), z_spans=[(z0, z1), (z0, z1)], pixels_tot=0.01, pixels_x=0.01, pixels_y=0.01,
            ref_gray=0.01, epipolar_band=settings["band_px"] * PITCH_MM, min_correlation=1.0,
        )  # fmt: skip
        self.volume.set_X_lay((x0, x1))
        self.volume.set_Zmin_lay((z0, z0))
        self.volume.set_Zmax_lay((z1, z1))

    def _calibration(self, matrix: Any, _coefficients: Any, rotation: Any, shift: Any) -> Any:
        # its camera looks along -z, with y up; it has one principal distance, so y is in units of fx (see flat)
        turn = rotation.T * (1.0, -1.0, -1.0)
        made = Calibration()
        made.set_pos(-rotation.T @ shift * 1000)
        made.set_angles(
            np.array(
                [np.arctan2(-turn[1, 2], turn[2, 2]), np.arcsin(turn[0, 2]), np.arctan2(-turn[0, 1], turn[0, 0])]
            )
        )
        x = (matrix[0, 2] + 0.5 - self.size[0] / 2) * PITCH_MM
        y = -(matrix[1, 2] + 0.5 - self.size[1] / 2) * PITCH_MM
        made.set_primary_point(np.array([x, y, matrix[0, 0] * PITCH_MM]))
        made.set_radial_distortion(np.zeros(3))
        made.set_decentering(np.zeros(2))
        made.set_affine_trans(np.array([1.0, 0.0]))
        # a ray must cross the glass (here of air) at an angle: the glass is upright just before the camera
        away = -rotation[2]
        made.set_glass_vec(away * (1000 * float(-rotation.T @ shift @ away) - GLASS_MM))
        return made

    def flat(self, camera: int, places: Any) -> Any:
        """Return image positions (n, 2) [px] of OpenPTV's pinhole: corner of the image at 0, square pixels."""
        matrix, coefficients, _, _ = self.given[camera]
        xy = straightened(np.asarray(places, float).reshape(-1, 2), matrix, coefficients)
        xy[:, 1] = matrix[1, 2] + (xy[:, 1] - matrix[1, 2]) * matrix[0, 0] / matrix[1, 1]
        return xy + 0.5

    def positions(self, places: Any) -> Any:
        """Return points (n, 3) [m] from flat image positions (n, cameras, 2), NaN where a camera has none."""
        xyz = np.full((len(places), 3), np.nan)
        seen = np.isfinite(places[:, :, 0])
        for which in {tuple(row) for row in seen.tolist()}:
            if sum(which) < 2:
                continue
            rows, cameras = np.flatnonzero((seen == which).all(axis=1)), np.flatnonzero(which)
            metric = np.stack(
                [convert_arr_pixel_to_metric(np.ascontiguousarray(places[rows, c]), self.control) for c in cameras], 1
            )
            metric -= [self.calibrations[c].get_primary_point()[:2] for c in cameras]
            chosen = [self.calibrations[c] for c in cameras]
            control = ControlParams(len(chosen), image_size=self.size, pixel_size=(PITCH_MM, PITCH_MM), flags=["hp"])
            media = control.get_multimedia_params()
            media.set_n1(1.0)
            media.set_layers([1.0], [1.0])
            media.set_n3(1.0)
            found_mm = point_positions(np.ascontiguousarray(metric), control, chosen, self.volume)[0]
            xyz[rows] = found_mm @ self.turn / 1000
        low, high = np.array(self.volume_m)
        xyz[~((xyz >= low) & (xyz <= high)).all(axis=1)] = np.nan
        return xyz


def found(dataset: Dataset, settings: dict[str, Any]) -> Iterator[tuple[str, int, float, float]]:
    """Yield the targets of all images; OpenPTV counts from the image's corner, pixel centres at a half."""
    rig = OpenPTVRig(dataset, settings)
    area = np.pi / 4 * dataset.about["marker_diameter_px"] ** 2
    target = TargetParams(
        discont=settings["discontinuity"], gvthresh=[settings["threshold"]] * MOST_CAMERAS,
        pixel_count_bounds=(max(2, round(0.2 * area)), max(30, round(5 * area))), xsize_bounds=(1, 200),
        ysize_bounds=(1, 200), min_sum_grey=settings["threshold"],
    )  # fmt: skip
    for k in rig.used:
        camera = dataset.names[k]
        for frame, image in dataset.prepared(camera, lambda path: np.array(Image.open(path)), settings["background"]):
            if settings["highpass_px"]:
                image = preprocess_image(np.ascontiguousarray(image), 0, rig.control, settings["highpass_px"])
            for one in target_recognition(np.ascontiguousarray(image), target, 0, rig.control):
                u, v = one.pos()
                yield camera, frame, u - 0.5, v - 0.5


def detect(dataset: Dataset, out: str, settings: dict[str, Any]) -> None:
    """Write the targets of all images."""
    write_detections(out, found(dataset, settings))


def points(dataset: Dataset, out: str, settings: dict[str, Any]) -> None:
    """Write the points of quadruplets, triplets and, with two cameras or by a setting, pairs."""
    rig = OpenPTVRig(dataset, settings)
    seen: dict[int, dict[str, list[tuple[float, float]]]] = {}
    for camera, frame, u, v in found(dataset, settings):
        seen.setdefault(frame, {}).setdefault(camera, []).append((u, v))
    least = min(len(rig.used), settings["least_cameras"])
    frames, xyz = [], []
    for frame, images in sorted(seen.items()):
        lists, flat = [], []
        for k, index in enumerate(rig.used):
            places = rig.flat(k, images.get(dataset.names[index], []))
            targets = TargetArray(len(places))
            for i, (x, y) in enumerate(places):
                targets[i].set_pos((float(x), float(y)))
                targets[i].set_pixel_counts(50, 8, 8)
                targets[i].set_sum_grey_value(5000)
                targets[i].set_pnr(i)
                targets[i].set_tnr(-1)
            lists.append(targets)
            flat.append(MatchedCoords(targets, rig.control, rig.calibrations[k]))
        for group in correspondences(lists, flat, rig.calibrations, rig.volume, rig.control)[0]:
            places = np.asarray(group, float).transpose(1, 0, 2).copy()
            places[places < -100] = np.nan
            places = places[np.isfinite(places[:, :, 0]).sum(axis=1) >= least]
            frames += [frame] * len(places)
            xyz.append(rig.positions(places))
    write_points(out, np.array(frames, int), np.concatenate([*xyz, np.empty((0, 3))]))


def triangulate(dataset: Dataset, out: str, settings: dict[str, Any], matched: str) -> None:
    """Write the points of targets whose images are known."""
    rig = OpenPTVRig(dataset, settings)
    frame, places = dataset.read_matched(matched)
    flat = np.full((len(places), len(rig.used), 2), np.nan)
    for k, index in enumerate(rig.used):
        seen = np.isfinite(places[:, index, 0])
        flat[seen, k] = rig.flat(k, places[seen, index])
    write_points(out, frame, rig.positions(flat))


if __name__ == "__main__":
    run({"points": points, "detect": detect, "triangulate": triangulate})
