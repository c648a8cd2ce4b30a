"""Each failure of a calibration has a code of its own, raised near its limit; good calibrations have no findings."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import HEIGHT, WIDTH
from calibration_scenes import (
    DIAMETER_M,
    bar_sightings,
    board_calibration,
    board_points,
    board_poses,
    calibration_of,
    disturbed,
    field_calibration,
    field_points,
    good_rig,
    overhead,
    seen,
)
from rigs import looking_at
from scipy.spatial.transform import Rotation

from mosca.calibration.quality.checks import check_calibration
from mosca.calibration.quality.findings import CODES
from mosca.calibration.quality.interior import depth_range, distance_correlation
from mosca.calibration.quality.network import coverage, links, volume_coverage
from mosca.calibration.quality.scale import length_errors, scale_error, size_ratio
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.errors import InputError


def codes(findings, *, notes=False) -> set[str]:
    return {one.code for one in findings if notes or one.severity != "note"}


def turned(camera: Camera, rad: float, shift_m: float = 0.0) -> Camera:
    pose = camera.world_from_camera
    turn = Rotation.from_rotvec([rad * 0.6, rad * 0.8, 0]).as_matrix()
    return replace(camera, world_from_camera=Pose(pose.rotation @ turn, pose.translation + [shift_m, 0, 0]))


@pytest.mark.parametrize(
    ("rig_of", "calibrated", "first", "seed"),
    [(good_rig, field_calibration, 1000, k) for k in range(22)]
    + [(overhead, board_calibration, 2000, k) for k in range(14)],
)
def test_a_good_field_or_board_raises_nothing(rig_of, calibrated, first, seed):
    cameras = rig_of(np.random.default_rng(first + seed))
    calibration = calibrated(seed, cameras)
    findings = check_calibration(calibration, known=Rig(tuple(cameras)), target_diameters_m=DIAMETER_M)
    assert codes(findings) == set(), findings


@pytest.mark.parametrize("seed", range(6))
def test_good_waved_points_raise_nothing(seed):
    # as a wand gives them: positions unknown, each seen in one frame only
    rng = np.random.default_rng(4000 + seed)
    cameras = good_rig(rng, 4)
    world = rng.uniform(-1, 1, (200, 3)) * [1.1, 1.1, 0.9] + [0, 0, 1]
    rows = [(r[0], r[2], *r[2:]) for r in seen(cameras, world, rng)]
    twice = np.bincount([r[2] for r in rows], minlength=200) >= 2
    rows = [r for r in rows if twice[r[2]]]
    start = disturbed(cameras, rng, 0.002, 0.005, 1.002)
    calibration = calibration_of(cameras, start, ("f_px", "k1"), rows, world, "wand", free_marks=True)
    assert codes(check_calibration(calibration, known=Rig(tuple(cameras)))) == set()


def far_plane(distance, noise_px, tilt=0.5, poses=1):
    """Return two cameras resected, lens held, from a plane of 0.6 m seen at ``distance``; from more poses, placed."""
    rng = np.random.default_rng(5)
    plane = board_points(5, 4, 0.15)
    lens = OpenCVLens(250.0 * distance, 250.0 * distance, 640, 510)
    cameras = []
    for k in range(2):
        centre = [distance * np.sin(tilt), 0.3 * k, distance * np.cos(tilt)]
        cameras.append(Camera(f"c{k}", WIDTH, HEIGHT, lens, looking_at(centre, [0, 0, 0])))
    if poses == 1:
        rows = seen(cameras, plane, rng, noise_px)
        start = disturbed(cameras, rng, 1e-4, 1e-3, keep_lens=True)
        return calibration_of(cameras, start, (), rows, plane, "plane", noise_px=noise_px)
    at = [Pose(Rotation.from_rotvec([0.5 * f, -0.4 * f, 0]).as_matrix(), np.zeros(3)) for f in range(poses)]
    rows = [r for f, p in enumerate(at) for r in seen(cameras, p.transform(plane), rng, noise_px, f, f)]
    start = [cameras[0], *disturbed(cameras[1:], rng, 1e-4, 1e-3, keep_lens=True)]
    return calibration_of(cameras, start, (), rows, plane, "plane", at, True, noise_px)


def test_mirrored_pose_is_refused():
    assert codes(check_calibration(far_plane(40.0, 0.5))) == {"mirrored-pose"}


def test_perspective_decides_the_pose_and_so_do_other_views():
    assert codes(check_calibration(far_plane(4.0, 0.1))) == set()
    assert codes(check_calibration(far_plane(40.0, 0.5, poses=3))) == set()


def shallow(relief, free=("f_px",), noise_px=0.1):
    rng = np.random.default_rng(6)
    points = field_points(rng, (2.6, 2.2, relief), (6, 6, 3))
    lens = OpenCVLens(1000.0, 1000.0, 640, 510)
    cameras = [
        Camera(f"c{k}", WIDTH, HEIGHT, lens, looking_at([0.3 * k, 0.02, 3.6], [0.3 * k, 0, 1])) for k in range(2)
    ]
    return field_calibration(6, cameras, points, noise_px, free)


def test_little_depth_is_told_with_its_correlation():
    flat = shallow(0.02)
    findings = check_calibration(flat)
    assert codes(findings) == {"little-depth"}
    assert depth_range(flat, 0) < 0.05
    assert abs(distance_correlation(flat, 0)[0]) > 0.99
    assert codes(check_calibration(shallow(0.8))) == set()


def test_few_points_leave_nothing_to_notice_mistakes_by():
    rng = np.random.default_rng(7)
    cameras = good_rig(rng, 2)
    few, more = field_points(rng, (1.4, 1.4, 1.0), (2, 2, 2)), field_points(rng, n=(3, 3, 3))
    for points, told in ((few, True), (more, False)):
        calibration = field_calibration(7, cameras, points, free=("f_px", "cx_px", "cy_px"))
        assert ("few-views" in codes(check_calibration(calibration))) == told


@pytest.mark.parametrize(("frames", "severity"), [(2, "refuse"), (4, "warn"), (8, None)])
def test_few_views_of_a_board(frames, severity):
    rng = np.random.default_rng(8)
    poses = board_poses(rng, frames, 0.6, 0.3)
    findings = check_calibration(board_calibration(8, poses=poses, free=("f_px",)))
    assert {f.severity for f in findings if f.code == "few-views"} == ({severity} if severity else set())


@pytest.mark.parametrize(("scale", "expected"), [(1.10, {"wrong-size"}), (0.95, {"wrong-size"}), (1.02, set())])
def test_wrong_size_shows_in_the_marks_images(scale, expected):
    calibration = field_calibration(9, scale=scale)
    ratio, sigma, *_ = size_ratio(calibration, DIAMETER_M)
    assert ratio == pytest.approx(scale, abs=4 * sigma + 2e-3)
    assert codes(check_calibration(calibration, target_diameters_m=DIAMETER_M)) == expected


@pytest.mark.parametrize(
    ("scale", "diameter_m", "severity"),
    [
        *((scale, DIAMETER_M, "refuse") for scale in (1000.0, 100.0, 1 / 1000, 39.37)),
        # a file all in millimetres: the target stands too far away
        (1000.0, 1000 * DIAMETER_M, "warn"),
    ],
)
def test_mixed_units(scale, diameter_m, severity):
    findings = check_calibration(field_calibration(10, scale=scale), target_diameters_m=diameter_m)
    assert codes(findings) == {"mixed-units"}
    assert findings[0].severity == severity


@pytest.mark.parametrize(("scale", "expected"), [(1.0, set()), (1.0001, set()), (1.0006, {"scale-error"})])
def test_held_out_lengths_tell_the_scale(scale, expected):
    rng = np.random.default_rng(11)
    cameras = good_rig(rng, 4)
    calibration = field_calibration(11, cameras, scale=scale, noise_px=0.02)
    bar = bar_sightings(cameras, 1.0, 60, rng, 0.02)
    errors = length_errors(calibration, bar, 1.0, 2e-5)
    assert errors.scale_error == pytest.approx(scale - 1, abs=4 * errors.scale_sigma)
    assert 2e-5 < errors.scale_sigma < 1e-4
    assert codes(check_calibration(calibration, lengths=errors)) == expected


def test_held_out_lengths_are_honest_about_their_sigma():
    pulls = []
    for seed in range(12):
        rng = np.random.default_rng(3000 + seed)
        cameras = good_rig(rng, 3)
        calibration = field_calibration(seed, cameras, noise_px=0.1)
        errors = length_errors(calibration, bar_sightings(cameras, 0.5, 30, rng, 0.05), 0.5)
        pulls.append(errors.scale_error / errors.scale_sigma)
    # 12 values of unit variance: their rms lies in 0.5 to 1.6 but for 1 in 1000
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_lengths_need_two_frames_in_two_cameras():
    rng = np.random.default_rng(12)
    cameras = good_rig(rng, 2)
    bar = bar_sightings(cameras, 1.0, 1, rng)
    with pytest.raises(InputError, match="held-out lengths"):
        length_errors(Rig(tuple(cameras)), bar, 1.0)


def test_a_bar_in_millimetres_is_mixed_units():
    rng = np.random.default_rng(12)
    cameras = good_rig(rng, 3)
    errors = length_errors(Rig(tuple(cameras)), bar_sightings(cameras, 1.0, 5, rng), 1000.0)
    assert codes(scale_error(errors)) == {"mixed-units"}


@pytest.mark.parametrize("count", [2, 3, 4])
def test_swapped_cameras_are_named(count):
    rng = np.random.default_rng(20 + count)
    cameras = good_rig(rng, count)
    known = Rig(tuple(cameras))
    # the cables of the first two were exchanged: each name has the other's pictures
    swapped = [replace(cameras[1], name="c0"), replace(cameras[0], name="c1"), *cameras[2:]]
    findings = check_calibration(field_calibration(20, swapped), known=known)
    assert codes(findings) == {"swapped-cameras"}
    assert "'c0' and 'c1'" in findings[0].message
    assert findings[0].severity == "refuse"


def test_a_board_put_elsewhere_is_no_exchange():
    rng = np.random.default_rng(25)
    cameras = good_rig(rng, 3)
    motion = Pose(Rotation.from_rotvec([0.1, 0.2, 1.3]).as_matrix(), np.array([2.0, -1.0, 0.4]))
    known = Rig(tuple(replace(c, world_from_camera=motion @ c.world_from_camera) for c in cameras))
    assert codes(check_calibration(field_calibration(25, cameras), known=known)) == set()


@pytest.mark.parametrize(("rad", "expected"), [(5e-3, {"rig-moved"}), (2e-3, {"rig-moved"}), (1e-4, set())])
def test_a_moved_camera_is_named(rad, expected):
    rng = np.random.default_rng(26)
    cameras = good_rig(rng, 4)
    known = Rig((*cameras[:2], turned(cameras[2], rad), cameras[3]))
    findings = check_calibration(field_calibration(26, cameras, noise_px=0.02), known=known)
    assert {(f.code, f.camera) for f in findings if f.severity != "note"} == {(code, "c2") for code in expected}


def with_lens(calibration, index=0, **values):
    cameras = list(calibration.rig.cameras)
    cameras[index] = replace(cameras[index], lens=replace(cameras[index].lens, **values))
    return replace(calibration, rig=Rig(tuple(cameras)))


@pytest.fixture(scope="module")
def good():
    return field_calibration(30, good_rig(np.random.default_rng(30), 4))


@pytest.mark.parametrize(
    ("values", "bad"),
    [
        ({"fx_px": 200.0, "fy_px": 200.0}, True),
        ({"fx_px": 300.0, "fy_px": 300.0}, False),
        ({"fx_px": 26000.0, "fy_px": 26000.0, "k1": 0.0, "k2": 0.0}, True),
        ({"cx_px": 980.0}, True),
        ({"cx_px": 940.0}, False),
        ({"cy_px": 200.0}, True),
        ({"fx_px": 1000.0, "fy_px": 1060.0}, True),
        ({"fx_px": 1000.0, "fy_px": 1040.0}, False),
        ({"fx_px": 1000.0, "fy_px": 1000.0, "k1": -1.5, "k2": 0.0}, True),
        ({"fx_px": 800.0, "fy_px": 800.0, "k1": 1.5, "k2": 0.0}, True),
    ],
)
def test_an_interior_orientation_that_no_camera_has(good, values, bad):
    free = {"k1": 0.0, "k2": 0.0} | values
    found = {(f.code, f.camera) for f in check_calibration(with_lens(good, **free)) if f.severity != "note"}
    assert found == ({("interior-ran-away", "c0")} if bad else set())


def test_an_uncertain_principal_distance_ran_away(good):
    k = good.parameters.index("c1.f_px")
    wide = good.covariance.copy()
    wide[k, k] = (0.03 * 1000) ** 2
    assert codes(check_calibration(replace(good, covariance=wide))) == {"interior-ran-away"}


@pytest.mark.parametrize(("change", "expected"), [(1.04, {"interior-ran-away"}), (1.01, set())])
def test_a_principal_distance_unlike_the_known_one(good, change, expected):
    lens = good.rig.cameras[1].lens
    known = with_lens(good, 1, fx_px=lens.fx_px * change, fy_px=lens.fy_px * change)
    assert codes(check_calibration(good, known=known.rig)) - {"rig-moved"} == expected


def only(calibration, keep):
    """Return the calibration as if the other points had no positions."""
    residuals = np.where(keep[:, None], calibration.residuals_px, np.nan)
    return replace(calibration, used=calibration.used & keep, residuals_px=residuals)


def test_cameras_that_nothing_joins(good):
    see = good.sightings
    apart = np.where(see.camera < 2, see.mark % 2 == 0, see.mark % 2 == 1)
    findings = check_calibration(only(good, apart))
    assert codes(findings) == {"no-link"}
    assert "c0, c1; c2, c3" in findings[0].message
    assert "show the target there while both watch" in findings[0].message
    assert codes(check_calibration(only(good, apart), rigid_target=True)) == set()


@pytest.mark.parametrize(("common", "expected"), [(12, {"weak-link"}), (44, set())])
def test_cameras_joined_by_few_points(good, common, expected):
    see = good.sightings
    keep = (see.mark < common) | (see.mark % 2 == (see.camera >= 2))
    linked = only(good, keep)
    assert links(linked)[0, 2] <= common
    assert codes(check_calibration(linked)) == expected


def test_boards_join_cameras_by_views():
    well = board_calibration(31, frames=22, who=lambda f: {0, 1} if f < 10 else {1, 2} if f < 20 else {0, 1, 2})
    assert codes(check_calibration(well)) == set()
    poorly = board_calibration(31, frames=21, who=lambda f: {0, 1} if f < 19 else {1, 2})
    assert codes(check_calibration(poorly)) >= {"weak-link"}


def test_a_target_seen_in_the_middle_only():
    rng = np.random.default_rng(32)
    cameras = good_rig(rng, 3)
    points = field_points(rng, (0.9, 0.9, 0.9))
    findings = check_calibration(field_calibration(32, cameras, points, 0.02, ("f_px", "k1")))
    assert codes(findings) == {"little-coverage"}
    assert "corners without any: top left, top right, bottom left, bottom right" in findings[0].message


def test_coverage_counts_cells_between_points(good):
    # by hand: a field over the whole image leaves no hole
    xy = good.sightings.xy_px[good.sightings.camera == 0]
    box = np.ptp(xy, axis=0) / (WIDTH, HEIGHT)
    assert coverage(good, 0, (8, 6)).mean() <= min(1.0, (box[0] + 0.25) * (box[1] + 0.34))
    assert volume_coverage(good, (-1, -1, 0.4), (1, 1, 1.6)).mean() > 0.95
    assert volume_coverage(good, (-4, -4, 0), (4, 4, 8)).mean() < 0.1
    found = check_calibration(good, volume=((-4, -4, 0), (4, 4, 8)))
    assert codes(found) == {"little-coverage"}


@pytest.mark.parametrize(("share", "severity"), [(0.1, "warn"), (0.4, "refuse"), (0.02, None)])
def test_many_blunders(good, share, severity):
    rng = np.random.default_rng(33)
    bad = (good.sightings.camera == 1) & (rng.random(len(good.sightings)) < share)
    found = [f for f in check_calibration(replace(good, used=good.used & ~bad)) if f.severity != "note"]
    assert {(f.code, f.severity, f.camera) for f in found} == ({("blunders", severity, "c1")} if severity else set())


@pytest.mark.parametrize(("k1", "expected"), [(-0.05, {"lens-model"}), (-0.008, {"lens-model"}), (-1e-4, set())])
def test_a_lens_that_the_model_cannot_follow(k1, expected):
    rng = np.random.default_rng(34)
    cameras = overhead(rng)
    cameras = [replace(c, lens=OpenCVLens(1000.0, 1000.0, 640, 510, k1=k1)) for c in cameras]
    start = [replace(c, lens=replace(c.lens, k1=0.0)) for c in cameras]
    marks = board_points()
    poses = board_poses(rng, 25)
    rows = [r for f, p in enumerate(poses) for r in seen(cameras, p.transform(marks), rng, 0.05, f, f)]
    done = calibration_of(cameras, start, ("f_px",), rows, marks, "board", poses, True, 0.05)
    assert codes(check_calibration(done)) == expected


def test_weak_parameters_are_noted(good):
    findings = check_calibration(replace(good, weak=("c2.k2", "c2.cx_px"), held=("c2.k2",)))
    assert codes(findings) == set()
    weak = [f for f in findings if f.code == "weak-parameter"]
    assert len(weak) == 1
    assert weak[0].camera == "c2"
    assert "k2, cx_px" in weak[0].message


def test_findings_are_one_line_and_known():
    cases = [
        check_calibration(field_calibration(10, scale=1000.0), target_diameters_m=DIAMETER_M),
        check_calibration(far_plane(40.0, 0.5)),
    ]
    for finding in (f for case in cases for f in case):
        assert finding.code in CODES
        assert "\n" not in finding.message
        assert finding.message[0].islower() or finding.message[0].isdigit()
