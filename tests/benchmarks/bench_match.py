"""Correspondence and triangulation: time by markers and cameras, and OpenPTV's at equal gates.

    python tests/benchmarks/bench_match.py

One core, frames' detections in memory. Times are the least of many calls. OpenPTV (PyPI ``optv``) only matches; ours
includes the rays from pixels, and points with covariances.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "mosca"))
from test_match import detected, members, rig_of

from mosca.camera import project
from mosca.data.detections import Detections
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.match import MatchSettings, Predicted, match
from mosca.triangulate import bundle_rays

ROOM = (np.full(3, -2.0), np.full(3, 2.0))
SIGMA_PX = 0.03
SETS = 10


def least_ms(work: Callable[[], object], calls: int) -> float:
    """Return the least time of a call [ms]."""
    work()
    times = []
    for _ in range(calls):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return 1e3 * min(times)


def scaling() -> None:
    """Print times by markers and by cameras; images of 10 % of the markers missing, 5 % clutter."""
    print("cameras markers   rays ms  match ms  with tracks ms  us a marker  points  wrong")
    settings = MatchSettings(camera_sigma_px=0.0)
    for cameras, markers in [(4, n) for n in (10, 20, 50, 100, 200, 500, 1000)] + [
        (c, 200) for c in (2, 3, 8, 16, 32)
    ]:
        rng = np.random.default_rng(markers + cameras)
        rig, truth = rig_of(cameras), rng.uniform(-0.5, 0.5, (markers, 3))
        found, behind = detected(rig, truth, rng, clutter=markers // 20, miss=0.1)
        bundle = bundle_rays(rig, found, 0.0)
        tracks = Predicted(truth, np.tile(1e-6 * np.eye(3), (markers, 1, 1)))
        calls = 100 if cameras * markers < 2000 else 20
        rays_ms = least_ms(lambda rig=rig, found=found: bundle_rays(rig, found, 0.0), calls)
        alone = least_ms(lambda b=bundle: match(b, Predicted.nothing(), settings, ROOM, 0.014), calls)
        held = least_ms(lambda b=bundle, t=tracks: match(b, t, settings, ROOM, 0.014), calls)
        points = match(bundle, tracks, settings, ROOM, 0.014)
        wrong = sum(len(g) > 1 or -1 in g for g in members(rig, points, behind))
        print(
            f"{cameras:7d} {markers:7d} {rays_ms:9.3f} {alone:9.3f} {held:15.3f} "
            f"{1e3 * (rays_ms + held) / markers:12.2f} {len(points):7d} {wrong:6d}"
        )


def openptv_rig() -> Rig:
    """Return four cameras about a room, without distortion."""
    rng, cameras = np.random.default_rng(3), []
    for k in range(4):
        turn = np.pi / 4 + k * np.pi / 2 + rng.normal(0, 0.08)
        place = np.array([4.2 * np.cos(turn), 4.2 * np.sin(turn), 2.6])
        z = np.array([0, 0, 1.0]) - place
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        pose = Pose(np.column_stack([x, np.cross(z, x), z]), place)
        cameras.append(Camera(f"c{k}", 656, 491, OpenCVLens(640.0, 640.0, 327.5, 245.0), pose))
    return Rig(tuple(cameras))


class OpenPTV:
    """OpenPTV's correspondences on the rig's own calibration (mm; world and camera axes as it has them)."""

    def __init__(self, rig: Rig, band_px: float) -> None:
        from optv.calibration import Calibration
        from optv.parameters import ControlParams, VolumeParams

        self.control = ControlParams(4, image_size=(656, 491), pixel_size=(0.01, 0.01), flags=["hp"])
        media = self.control.get_multimedia_params()
        media.set_n1(1.0)
        media.set_layers([1.0], [1.0])
        media.set_n3(1.0)
        self.calibrations = []
        for camera in rig.cameras:
            # its camera looks along -z, y up
            turn = camera.world_from_camera.rotation * (1.0, -1.0, -1.0)
            one = Calibration()
            one.set_pos(camera.world_from_camera.translation * 1000)
            one.set_angles(
                np.array(
                    [
                        np.arctan2(-turn[1, 2], turn[2, 2]),
                        np.arcsin(turn[0, 2]),
                        np.arctan2(-turn[0, 1], turn[0, 0]),
                    ]
                )
            )
            one.set_primary_point(np.array([(327.5 - 328) * 0.01, -(245 - 245.5) * 0.01, 6.4]))
            one.set_radial_distortion(np.zeros(3))
            one.set_decentering(np.zeros(2))
            one.set_affine_trans(np.array([1.0, 0.0]))
            one.set_glass_vec(np.array([0, 0, 2050.0]))
            assert np.allclose(one.get_rotation_matrix(), turn, atol=1e-9)
            self.calibrations.append(one)
        self.volume = VolumeParams(
            x_span=(-1300, 1300), z_spans=[(100, 2000), (100, 2000)], pixels_tot=0.1, pixels_x=0.1,
            pixels_y=0.1, ref_gray=0.1, epipolar_band=band_px * 0.01, min_correlation=1.0,
        )  # fmt: skip
        self.volume.set_X_lay((-1300, 1300))
        self.volume.set_Zmin_lay((100, 100))
        self.volume.set_Zmax_lay((2000, 2000))

    def targets(self, found: dict[str, Detections]) -> list[object]:
        """Return detections as it takes them."""
        from optv.tracking_framebuf import TargetArray

        lists = []
        for one in found.values():
            targets = TargetArray(len(one))
            for i, (x, y) in enumerate(one.xy_px):
                targets[i].set_pos((float(x), float(y)))
                targets[i].set_pixel_counts(50, 8, 8)
                targets[i].set_sum_grey_value(5000)
                targets[i].set_pnr(i)
                targets[i].set_tnr(-1)
            lists.append(targets)
        return lists

    def match(self, targets: list[object]) -> list[np.ndarray]:
        """Return its groups: (cameras, n, 2) pixels, for quadruplets, triplets and pairs."""
        from optv.correspondences import MatchedCoords, correspondences

        flat = [MatchedCoords(t, self.control, c) for t, c in zip(targets, self.calibrations, strict=True)]
        return correspondences(targets, flat, self.calibrations, self.volume, self.control)[0]


def beside_openptv() -> None:
    """Print times and right and wrong groups of both on the same detections, gate 4.5 sigma of each image."""
    rig = openptv_rig()
    settings = MatchSettings(camera_sigma_px=0.0, judge_sizes=False)
    for clutter, miss in ((0, 0.0), (20, 0.1)):
        frames = []
        for seed in range(SETS):
            rng = np.random.default_rng(seed)
            truth = rng.uniform((-0.75, -0.75, 0.45), (0.75, 0.75, 1.55), (200, 3))
            frames.append((truth, *detected(rig, truth, rng, SIGMA_PX, clutter, miss)))
        # both images' errors in the gate: 4.5 sigma sqrt(2)
        theirs = OpenPTV(rig, 4.5 * SIGMA_PX * np.sqrt(2))
        check(theirs, rig, frames[0][0])
        spent = {"OpenPTV": 0.0, "mosca": 0.0}
        right, wrong = dict.fromkeys(spent, 0), dict.fromkeys(spent, 0)
        for _, found, behind in frames:
            targets = theirs.targets(found)
            spent["OpenPTV"] += least_ms(lambda o=theirs, t=targets: o.match(t), 3)
            for positions in theirs.match(theirs.targets(found)):
                for n in range(positions.shape[1]):
                    at = positions[:, n]
                    ids = {
                        int(behind[c.name][np.argmin(np.linalg.norm(found[c.name].xy_px - at[k], axis=1))])
                        for k, c in enumerate(rig.cameras)
                        if np.isfinite(at[k, 0]) and at[k, 0] > -100
                    }
                    good = len(ids) == 1 and -1 not in ids
                    right["OpenPTV"] += good
                    wrong["OpenPTV"] += not good
            work = lambda f=found: match(bundle_rays(rig, f, 0.0), Predicted.nothing(), settings, ROOM)  # noqa: E731
            spent["mosca"] += least_ms(work, 20)
            for group in members(rig, work(), behind):
                good = len(group) == 1 and -1 not in group
                right["mosca"] += good
                wrong["mosca"] += not good
        print(f"4 cameras x 200 markers, clutter {clutter} an image, {100 * miss:.0f} % of images missing:")
        for name, ms in spent.items():
            print(
                f"  {name:8s} {ms / SETS:7.3f} ms a set, right {right[name] / SETS:6.1f}, "
                f"wrong {wrong[name] / SETS:5.2f}"
            )
        print(f"  ratio {spent['OpenPTV'] / spent['mosca']:.1f}")


def check(theirs: OpenPTV, rig: Rig, points: np.ndarray) -> None:
    """Raise AssertionError where OpenPTV images points elsewhere: it must match on the same geometry."""
    from optv.imgcoord import image_coordinates
    from optv.transforms import convert_arr_metric_to_pixel

    for camera, calibration in zip(rig.cameras, theirs.calibrations, strict=True):
        flat = image_coordinates(points * 1000, calibration, theirs.control.get_multimedia_params())
        assert (
            np.abs(convert_arr_metric_to_pixel(flat, theirs.control) - project(camera, points)).max() < 1e-6
        )


if __name__ == "__main__":
    scaling()
    try:
        beside_openptv()
    except ImportError as missing:
        print(f"OpenPTV is not installed ({missing}): pip install 'mosca-testbench[bench]'")
