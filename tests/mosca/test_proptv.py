"""Real cameras before a water tank: the proPTV / OpenPTV / MyPTV comparison (MIT), four cameras, five target planes.

Calibrated from the planes at 26, 150 and 274 mm and scored on those at 88 and 212 mm: the known marker positions are
the reference. The parts of the score are measured here too: the image points are rounded to whole pixels, the
target was rotated and shifted a little from plane to plane, and a lens model alone cannot describe the refraction at
the water's surface, whose law is written out below.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mosca.calibration.bundle.solver import (
    Adjustment,
    BundleSettings,
    CameraUnknowns,
    ObjectPoints,
    Observations,
    Placements,
    Problem,
    solve,
)
from mosca.calibration.initial.resection import aim, resect
from mosca.camera.projection import project_with_jacobians
from mosca.data.files.rig_file import read_rig
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from scenarios.cli.main import cli

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
MARKERS = DATA / "proptv_calib_comparison" / "markerError_cases" / "markers"
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not MARKERS.is_dir(), reason=f"no proPTV comparison in {DATA} (set MOSCA_DATA)"),
]
SIZE = (2560, 2160)
TRAINED, HELD_OUT = (26.0, 150.0, 274.0), (88.0, 212.0)
BAR_MM = np.array([0.066, 0.058, 0.51])
ROUNDING_PX = 1 / np.sqrt(12)
# OpenCV's model without its rational part and tilt: what a lens alone can do here. The water's surface is a prism to
# a slanting camera, hence s1 to s4
FREE = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2", "s1", "s2", "s3", "s4")


@dataclass(frozen=True)
class Markers:
    """Image points (4 cameras, n, 2) [px] of target points (n, 3) [m]."""

    xy_px: np.ndarray
    xyz: np.ndarray

    def on(self, planes_mm: tuple[float, ...]) -> "Markers":
        chosen = np.isin(np.round(1000 * self.xyz[:, 2]), planes_mm)
        return Markers(self.xy_px[:, chosen], self.xyz[chosen])


@pytest.fixture(scope="module")
def markers() -> Markers:
    tables = [np.loadtxt(MARKERS / f"markers_c{k}.txt") for k in range(4)]
    assert all((one[:, 2:] == tables[0][:, 2:]).all() for one in tables)
    return Markers(np.array([one[:, :2] for one in tables]), tables[0][:, 2:] / 1000)


def resected_camera(name: str, xy_px: np.ndarray, xyz: np.ndarray, rng: np.random.Generator) -> Camera:
    """Return a camera without distortion, its principal point in the middle of the image, to start from."""
    first = resect(f"camera '{name}'", xy_px, xyz, rng)
    centre = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    return Camera(name, *SIZE, OpenCVLens(first.lens.fx_px, first.lens.fy_px, *centre), aim(first, centre))


def stand_centres(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle of each plane (s, 3) [m] of points (p, 3), and each point's plane (p,)."""
    _, stand = np.unique(points[:, 2], return_inverse=True)
    return np.array([points[stand == k].mean(axis=0) for k in range(stand.max() + 1)]), stand


def adjusted(train: Markers, stands: bool = False) -> Adjustment:
    """Adjust all cameras together; with ``stands`` the poses of all planes but the first, too.

    Errors common to all cameras are the target's, since one camera's lens cannot explain them.
    """
    cameras, n = len(train.xy_px), len(train.xyz)
    rngs = np.random.default_rng(1).spawn(cameras)
    starts = [resected_camera(f"c{k}", train.xy_px[k], train.xyz, rngs[k]) for k in range(cameras)]
    centres, stand = stand_centres(train.xyz)
    free = stand > 0 if stands else np.zeros(n, dtype=bool)
    poses = [Pose(np.eye(3), centre) for centre in centres[1:]] if stands else []
    problem = Problem(
        tuple(CameraUnknowns(one, free=FREE) for one in starts),
        Observations(
            np.repeat(np.arange(cameras), n),
            np.tile(np.arange(n), cameras),
            train.xy_px.reshape(-1, 2),
            np.tile(np.where(free, stand - 1, -1), cameras),
            ROUNDING_PX,
        ),
        ObjectPoints.fixed(np.where(free[:, None], train.xyz - centres[stand], train.xyz)),
        Placements.of(poses),
    )
    return solve(problem, BundleSettings(precision=False, blunder_significance=None if stands else 0.01))


@pytest.fixture(scope="module")
def calibrated(markers) -> Adjustment:
    return adjusted(markers.on(TRAINED))


def triangulated(cameras: tuple[Camera, ...], seen: Markers) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (n, 3) [m] of least squares in the images, and their covariances for 1 px (n, 3, 3)."""
    points = seen.xyz.copy()
    for _ in range(6):
        normal, slope = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for camera, xy in zip(cameras, seen.xy_px, strict=True):
            there = project_with_jacobians(camera, points)
            normal += np.einsum("nij,nik->njk", there.by_point, there.by_point)
            slope += np.einsum("nij,ni->nj", there.by_point, xy - there.xy_px)
        points = points + np.linalg.solve(normal, slope[:, :, None])[:, :, 0]
    return points, np.linalg.inv(normal)


def rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.square(values), axis=0))


def as_stands(error: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the part of errors (n, 3) explained by a shift and rotation of each plane, and these motions (s, 6)."""
    centres, stand = stand_centres(xyz)
    explained, motions = np.empty_like(error), []
    for k, centre in enumerate(centres):
        on = stand == k
        x, y = (xyz[on] - centre)[:, :2].T
        design = np.zeros((3, on.sum(), 6))
        design[0, :, 0] = design[1, :, 1] = design[2, :, 2] = 1.0
        design[2, :, 3], design[2, :, 4], design[0, :, 5], design[1, :, 5] = y, -x, -y, x
        motion = np.linalg.lstsq(design.reshape(-1, 6), error[on].T.ravel(), rcond=None)[0]
        explained[on] = (design @ motion).T
        motions.append(motion)
    return explained, np.array(motions)


def test_held_out_planes_are_measured_within_the_bar(markers, calibrated):
    # measured: 0.063, 0.058, 0.490 mm; the four programs that the set compares: SOURCE.md
    test = markers.on(HELD_OUT)
    error_mm = 1000 * (triangulated(calibrated.cameras, test)[0] - test.xyz)
    print("held_out_rms_mm", rms(error_mm).tolist())
    print("sigma0_px", calibrated.sigma0 * ROUNDING_PX)
    assert (rms(error_mm) <= BAR_MM).all(), rms(error_mm)
    assert len(calibrated.rejected) < 0.01 * len(calibrated.used)


def through_the_verb(folder: Path, train: Markers, *options: str) -> Rig:
    """Return the rig file that ``mosca calibrate`` writes from these points' text files."""
    for k, xy in enumerate(train.xy_px):
        np.savetxt(folder / f"markers_c{k}.txt", np.column_stack([xy, 1000 * train.xyz]))
    cameras = "\n".join(f'[[camera]]\nname = "c{k}"\nfile = "markers_c{k}.txt"' for k in range(4))
    target, out = folder / "target.toml", folder / "rig.toml"
    target.write_text(f'kind = "points"\nunit = "mm"\nsize_px = [{SIZE[0]}, {SIZE[1]}]\n{cameras}\n')
    done = CliRunner().invoke(cli, ["calibrate", str(folder), "--target", str(target), "--out", str(out), *options])
    assert done.exit_code == 0, done.output
    return read_rig(out)


@pytest.mark.parametrize(
    ("options", "most_mm"),
    [
        # all terms but the rational part and the tilt; measured 0.0628, 0.0574, 0.489 mm
        (("--lens", "opencv", "--free", ",".join(FREE)), BAR_MM),
        # parameters chosen by the data, s1 to s4 among them; measured 0.0628, 0.0581, 0.488 mm
        (("--lens", "opencv"), (0.066, 0.0585, 0.51)),
        # the paper's model, parameters chosen by the data; measured 0.067, 0.061, 0.478 mm
        ((), (0.070, 0.064, 0.52)),
    ],
    ids=["opencv, all", "opencv", "mosca"],
)
def test_held_out_planes_through_the_verb(markers, tmp_path, options, most_mm):
    rig = through_the_verb(tmp_path, markers.on(TRAINED), *options)
    test = markers.on(HELD_OUT)
    error_mm = 1000 * (triangulated(rig.cameras, test)[0] - test.xyz)
    print("held_out_rms_mm", options, rms(error_mm).tolist())
    assert (rms(error_mm) <= most_mm).all(), rms(error_mm)
    if "opencv" in options:
        assert all(camera.lens.s1 != 0 for camera in rig.cameras)


def test_image_points_are_exact_but_for_their_rounding(markers):
    """A smooth map of each plane's own leaves 0.31 px, the rounding to whole pixels 0.289: no blur, no blunder."""
    left = []
    for z in (*TRAINED, *HELD_OUT):
        plane = markers.on((z,))
        x, y = (plane.xyz[:, :2] - 0.15).T / 0.135
        powers = [(i, j) for i in range(6) for j in range(6 - i)]
        design = np.column_stack([x**i * y**j for i, j in powers])
        freedom = (len(x) - len(powers)) / len(x)
        for xy in plane.xy_px:
            rest = xy - design @ np.linalg.lstsq(design, xy, rcond=None)[0]
            left.append(rms(rest) / np.sqrt(freedom))
    assert ROUNDING_PX - 0.01 < np.median(left) < 0.32
    assert np.max(left) < 0.40


def test_what_the_held_out_error_is_made_of(markers, calibrated):
    test = markers.on(HELD_OUT)
    points, cofactor = triangulated(calibrated.cameras, test)
    error_mm = 1000 * (points - test.xyz)
    stands_mm, motion = as_stands(error_mm, test.xyz)
    rest_mm = error_mm - stands_mm
    rounding_mm = 1000 * ROUNDING_PX * np.sqrt(np.diagonal(cofactor, axis1=1, axis2=2).mean(axis=0))
    for name, value in (("stands", rms(stands_mm)), ("rest", rms(rest_mm)), ("rounding", rounding_mm)):
        print(f"{name}_rms_mm", value.tolist())
    np.testing.assert_allclose(rounding_mm, (0.025, 0.025, 0.128), atol=0.002)
    # the held-out planes were a little rotated and shifted themselves, which no calibration can know
    assert ((rms(stands_mm)[:2] > 0.035) & (rms(stands_mm)[:2] < 0.06)).all()
    assert (rms(rest_mm)[:2] < 0.042).all()  # rounding 0.025, so the lens model's own misfit is 0.03 mm or less
    turns_mrad = motion[:, 5]
    assert -0.7 < turns_mrad[0] < -0.4  # at 88 mm
    assert 0.3 < turns_mrad[1] < 0.6  # at 212 mm


def test_the_target_turned_along_its_traverse(markers, calibrated):
    """Four cameras agree that the planes are rotated by -1, 0 and +1 mrad about the traverse, as the held-out ones
    (between them) are by half as much.
    """
    free = adjusted(markers.on(TRAINED), stands=True)
    turns = 1e3 * Rotation.from_matrix(free.placements.rotation).as_rotvec()[:, 2]
    print("turns_mrad", turns.tolist())
    np.testing.assert_allclose(turns, (1.06, 2.03), atol=0.07)  # against the first plane
    assert free.sigma0 < 0.92 * calibrated.sigma0


def refracted(centre: np.ndarray, points: np.ndarray, surface_m: float, index: float) -> np.ndarray:
    """Return where (n, 3), on the water's surface, the light of points below passes on its way to ``centre``."""
    away = points[:, :2] - centre[:2]
    across, above, below = np.linalg.norm(away, axis=1), centre[2] - surface_m, surface_m - points[:, 2]
    r = across * above / (above + below / index)
    for _ in range(12):  # Newton's method for Snell's law
        up, down = np.hypot(r, above), np.hypot(across - r, below)
        slope = above**2 / up**3 + index * below**2 / down**3
        r = r - (r / up - index * (across - r) / down) / slope
    return np.column_stack([centre[:2] + away * (r / across)[:, None], np.full(len(r), surface_m)])


def pinhole_misfit_px(index: float, markers: Markers, start: Camera) -> float:
    """Return the rms misfit of a pinhole with k1 above water of refractive index ``index``, surface at 0.3 m."""
    xy = markers.xy_px[int(start.name[1])]

    def residuals(p: np.ndarray) -> np.ndarray:
        through = refracted(p[3:6], markers.xyz, 0.3, index) - p[3:6]
        v = through @ Rotation.from_rotvec(p[:3]).as_matrix()
        ideal = v[:, :2] / v[:, 2:]
        radial = 1 + p[9] * np.sum(ideal**2, axis=1, keepdims=True)
        return (1000 * (p[6] * ideal * radial + p[7:9]) - xy).ravel()

    pose, lens = start.world_from_camera, start.lens
    turn = Rotation.from_matrix(pose.rotation).as_rotvec()
    first = np.concatenate([turn, pose.translation, [lens.fx_px / 1e3, lens.cx_px / 1e3, lens.cy_px / 1e3, 0]])
    return float(np.sqrt(np.mean(least_squares(residuals, first, x_scale=0.01).fun ** 2)))


def test_the_missing_physics_is_refraction(markers):
    """The same ten unknowns, without prism or decentring: with Snell's law at the surface they nearly fit."""
    every = markers.on(TRAINED)
    train = Markers(every.xy_px[:, ::4], every.xyz[::4])
    for k in range(4):
        start = resected_camera(f"c{k}", train.xy_px[k], train.xyz, np.random.default_rng(k))
        air, water = (pinhole_misfit_px(index, train, start) for index in (1.0, 1.333))
        print(f"c{k}_misfit_px", [air, water])
        assert water < 1.0 < 3.0 < air
