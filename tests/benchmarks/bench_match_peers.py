"""Correspondence beside OpenPTV's (PyPI ``optv``) on the same detections, at equal gates: time, right, wrong.

    python tests/benchmarks/bench_match_peers.py

By markers 10 to 1,000 and cameras 2 to 4 (it takes no more); then ours alone up to 32 cameras. One core, detections
in memory; the least of several calls, of the thread's own time. OpenPTV only matches; ours includes the rays from
pixels, and points with covariances. The volume grows with the markers at constant density of targets, up to
the volume that all cameras see. Ours is shown without tracks (as theirs is) and with tracks that expect their targets
to 1 mm. A group is right where all its images are of one target; a target of which no group is right is missed, if
two cameras see it.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "mosca"))
sys.path.insert(0, str(Path(__file__).parent))
from bench_match import exponent, least_ms
from rigs import looking_at
from test_match import detected, members

from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import MatchSettings, match
from mosca.data.detections import Detections
from mosca.data.rays import Predicted
from mosca.data.rig import Camera, OpenCVLens, Rig
from mosca.data.tracks import Points

SIGMA_PX = 0.03
SETS = 3
ROOM = (np.array([-1.3, -1.3, 0.1]), np.array([1.3, 1.3, 2.0]))
SETTINGS = MatchSettings(camera_sigma_px=0.0, judge_sizes=False)
DIAMETER_M = 0.014
Frame = tuple[np.ndarray, dict[str, Detections], dict[str, np.ndarray]]


def ring(count: int) -> Rig:
    """Return cameras around a volume, without distortion."""
    step = 2 * np.pi / count if count > 2 else np.pi / 2
    azimuths = np.pi / 4 + step * np.arange(count) + np.random.default_rng(3).normal(0, 0.08, count)
    poses = [looking_at([4.2 * np.cos(a), 4.2 * np.sin(a), 2.6], [0, 0, 1.0]) for a in azimuths]
    lens = OpenCVLens(640.0, 640.0, 327.5, 245.0)
    return Rig(tuple(Camera(f"c{k}", 656, 491, lens, pose) for k, pose in enumerate(poses)))


class OpenPTV:
    """OpenPTV's correspondences on the rig's own calibration (mm; world and camera axes as it has them)."""

    def __init__(self, rig: Rig, band_px: float) -> None:
        from optv.calibration import Calibration
        from optv.parameters import ControlParams, VolumeParams

        self.control = ControlParams(len(rig.cameras), image_size=(656, 491), pixel_size=(0.01, 0.01), flags=["hp"])
        media = self.control.get_multimedia_params()
        media.set_n1(1.0)
        media.set_layers([1.0], [1.0])
        media.set_n3(1.0)
        self.calibrations = []
        for camera in rig.cameras:
            # its camera's axis is -z, y up
            turn = camera.world_from_camera.rotation * (1.0, -1.0, -1.0)
            one = Calibration()
            one.set_pos(camera.world_from_camera.translation * 1000)
            one.set_angles(
                np.array(
                    [np.arctan2(-turn[1, 2], turn[2, 2]), np.arcsin(turn[0, 2]), np.arctan2(-turn[0, 1], turn[0, 0])]
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


def check(theirs: OpenPTV, rig: Rig, points: np.ndarray) -> None:
    """Raise AssertionError where OpenPTV images points elsewhere: it must match on the same geometry."""
    from optv.imgcoord import image_coordinates
    from optv.transforms import convert_arr_metric_to_pixel

    for camera, calibration in zip(rig.cameras, theirs.calibrations, strict=True):
        flat = image_coordinates(points * 1000, calibration, theirs.control.get_multimedia_params())
        assert np.abs(convert_arr_metric_to_pixel(flat, theirs.control) - project(camera, points)).max() < 1e-6


def frames_of(rig: Rig, markers: int, clutter: int, miss: float) -> list[Frame]:
    """Return true points, detections, and what is behind each of them, of some sets."""
    frames = []
    half = 0.75 * min(1.0, (markers / 200) ** (1 / 3))
    for seed in range(SETS):
        rng = np.random.default_rng(seed)
        truth = rng.uniform(-half, half, (markers, 3)) + (0.0, 0.0, 1.0)
        frames.append((truth, *detected(rig, truth, rng, SIGMA_PX, clutter, miss)))
    return frames


def ours(rig: Rig, frames: list[Frame], expected: bool) -> tuple[float, float, float, float]:
    """Return ms a set, and groups right, wrong and targets missed a set."""
    spent, counts = 0.0, np.zeros(3)
    for truth, found, behind in frames:
        tracks = Predicted(truth, np.tile(1e-6 * np.eye(3), (len(truth), 1, 1))) if expected else Predicted.nothing()
        size = DIAMETER_M if expected else 0.0

        def work(found: dict = found, tracks: Predicted = tracks, size: float = size) -> Points:
            return match(make_ray_table(rig, found, 0.0), tracks, SETTINGS, ROOM, size)

        spent += least_ms(work, 20 if len(truth) <= 200 else 5)
        counts += judged(members(rig, work(), behind), behind)
    return (spent / len(frames), *(counts / len(frames)))


def theirs(rig: Rig, frames: list[Frame]) -> tuple[float, float, float, float]:
    """Return the same of OpenPTV."""
    # both images' errors in the gate: 4.5 sigma sqrt(2)
    peer = OpenPTV(rig, 4.5 * SIGMA_PX * np.sqrt(2))
    check(peer, rig, frames[0][0])
    spent, counts = 0.0, np.zeros(3)
    for _, found, behind in frames:
        targets = peer.targets(found)
        spent += least_ms(lambda o=peer, t=targets: o.match(t), 3)
        groups = []
        for positions in peer.match(peer.targets(found)):
            for n in range(positions.shape[1]):
                at = positions[:, n]
                groups.append({
                    int(behind[c.name][np.argmin(np.linalg.norm(found[c.name].xy_px - at[k], axis=1))])
                    for k, c in enumerate(rig.cameras)
                    if np.isfinite(at[k, 0]) and at[k, 0] > -100
                })  # fmt: skip
        counts += judged(groups, behind)
    return (spent / len(frames), *(counts / len(frames)))


def judged(groups: list[set[int]], behind: dict[str, np.ndarray]) -> tuple[int, int, int]:
    """Return how many groups are right and wrong, and how many targets that two cameras see have none."""
    good = {next(iter(g)) for g in groups if len(g) == 1 and -1 not in g}
    right = sum(len(g) == 1 and -1 not in g for g in groups)
    seen = np.bincount(np.concatenate([b[b >= 0] for b in behind.values()]))
    return right, len(groups) - right, int((seen >= 2).sum()) - len(good)


def main() -> None:
    """Print the tables."""
    try:
        import optv  # noqa: F401
    except ImportError as missing:
        print(f"OpenPTV is not installed ({missing}): pip install 'mosca-testbench[bench]'")
        return
    columns = "      ms   right  wrong missed"
    for clutter, miss in ((0.0, 0.0), (0.1, 0.1)):
        print(f"clutter {100 * clutter:.0f} % of the targets an image, {100 * miss:.0f} % of images missing")
        print(f"cameras markers | OpenPTV {columns} | alone {columns} | with tracks {columns} | ratios")
        grown: dict[str, list[tuple[int, float]]] = {"OpenPTV": [], "alone": [], "with tracks": []}
        for cameras, markers in [(4, n) for n in (10, 20, 50, 100, 200, 500, 1000)] + [(2, 200), (3, 200)]:
            rig = ring(cameras)
            frames = frames_of(rig, markers, round(clutter * markers), miss)
            rows = theirs(rig, frames), ours(rig, frames, False), ours(rig, frames, True)
            for name, row in zip(grown, rows, strict=True):
                if cameras == 4 and markers >= 50:
                    grown[name].append((markers, row[0]))
            told = " | ".join(
                f"{ms:14.3f} {right:7.1f} {wrong:6.2f} {missed:6.2f}" for ms, right, wrong, missed in rows
            )
            print(
                f"{cameras:7d} {markers:7d} | {told} | {rows[0][0] / rows[1][0]:6.1f} {rows[0][0] / rows[2][0]:6.1f}",
                flush=True,
            )
        slopes = ", ".join(f"{name} {exponent(pairs):.2f}" for name, pairs in grown.items())
        print(f"time ~ markers^k from 50 on, 4 cameras: k = {slopes}")
        more = []
        for cameras in (3, 4, 8, 16, 32):
            rig = ring(cameras)
            frames = frames_of(rig, 200, round(clutter * 200), miss)
            alone, held = ours(rig, frames, False), ours(rig, frames, True)
            more.append((cameras, held[0]))
            print(
                f"{cameras:7d}     200 | alone {alone[0]:.3f} ms, {alone[1]:.1f} right, {alone[2]:.2f} wrong, "
                f"{alone[3]:.2f} missed | with tracks {held[0]:.3f} ms, {held[1]:.1f} right, {held[2]:.2f} wrong, "
                f"{held[3]:.2f} missed"
            )
        print(f"time ~ cameras^k from 3 to 32, 200 markers, with tracks: k = {exponent(more):.2f}")


if __name__ == "__main__":
    main()
