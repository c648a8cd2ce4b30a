"""Worn cameras by each other's lamps: codes read from frames, poses from sightings alone, markers out of all of it.

Images are computed here by the equidistant projection (radius = f x angle); two cameras are still, one is moved.
"""

import numpy as np
import pytest
from continuous_sessions import as_detections
from rigs import looking_at
from scipy.spatial.transform import Rotation

from mosca.continuous.association.associate import AssociationSettings
from mosca.continuous.association.blink_codes import NO_LAMP, LampSettings, blinking
from mosca.continuous.association.frame_detections import CameraDetections
from mosca.continuous.estimator.estimate import ContinuousSettings
from mosca.continuous.model.rig_at_time import MovingRig, images_at
from mosca.continuous.moving_cameras.body_worn import Lamps, solve_worn
from mosca.continuous.moving_cameras.mutual_pose import LampRays, lamp_rays, poses_from_lamps
from mosca.correspondence.match import MatchSettings
from mosca.data.frames import CameraInfo
from mosca.data.lamp_codes import lamp_bits
from mosca.data.rig import Camera, FisheyeLens, Pose, Rig
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings

FOCAL, WIDTH, HEIGHT, RATE_HZ, LAST_S, SIGMA_PX = 235.0, 656, 491, 60.0, 1.3, 0.05
LAMP_M = np.array([[0.0, 0.03, -0.02], [0.01, 0.03, 0.0], [0.0, -0.03, -0.01]])
NUMBERS = (0, 3, 5)
LATE_S = (0.0, 0.011, 0.006)
SHIFT_S = 0.0083
"""Phase of the lamps' bit at time 0, unknown to the cameras."""


STANDING = (looking_at([-0.5, -0.6, 0.2], [0.1, 0.2, 0.0]), looking_at([0.5, -0.6, 0.2], [-0.1, 0.2, 0.0]))


def pose_of(camera: int, time_s: float) -> Pose:
    """The third camera swings as a forearm does: 0.3 rad and 5 cm to and fro."""
    if camera < 2:
        return STANDING[camera]
    rest = looking_at([0.1, 0.7, 0.3], [0.0, -0.1, 0.0])
    angle = 0.3 * np.sin(2 * np.pi * 0.6 * time_s)
    turn = Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8])).as_matrix()
    move = 0.05 * np.array([np.sin(5.0 * time_s), np.cos(4.0 * time_s), 0.4 * np.sin(3.0 * time_s)])
    return Pose(turn @ rest.rotation, rest.translation + move)


def markers(time_s: float) -> np.ndarray:
    k = np.arange(9)
    base = np.column_stack([0.25 * np.cos(2.4 * k), 0.25 * np.sin(2.4 * k), 0.06 * (k - 4)])
    sway = 0.05 * np.column_stack([np.sin(4 * time_s + k), np.cos(3 * time_s + 2 * k), np.sin(5 * time_s + k)])
    return base + sway


def image(pose: Pose, xyz: np.ndarray) -> np.ndarray:
    x, y, z = ((xyz - pose.translation) @ pose.rotation).T
    across = np.hypot(x, y)
    radius = FOCAL * np.arctan2(across, z) / across
    return np.column_stack([(WIDTH - 1) / 2 + radius * x, (HEIGHT - 1) / 2 + radius * y])


def lit(number: int, time_s: float) -> bool:
    bits = lamp_bits(number)
    return bits[int(np.floor((time_s + SHIFT_S) * RATE_HZ)) % len(bits)]


def rig(known_pose: bool = True) -> Rig:
    lens = FisheyeLens(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    nowhere = Pose(np.eye(3), np.zeros(3))
    poses = [pose_of(c, 0.0) if c < 2 or known_pose else nowhere for c in range(3)]
    return Rig(tuple(Camera(f"c{c}", WIDTH, HEIGHT, lens, pose) for c, pose in enumerate(poses)))


@pytest.fixture(scope="module")
def session() -> tuple[tuple[CameraDetections, ...], list[np.ndarray]]:
    """Return what the three cameras see, and of each image point the camera whose lamp it is, or -1."""
    rng = np.random.default_rng(5)
    found, whose = [], []
    for c in range(3):
        times = LATE_S[c] + np.arange(int(LAST_S * RATE_HZ)) / RATE_HZ
        points, owners = [], []
        for t in times:
            poses = [pose_of(k, t) for k in range(3)]
            lamps = [k for k in range(3) if k != c and lit(NUMBERS[k], t)]
            xyz = np.array([*markers(t), *(poses[k].transform(LAMP_M[k][None])[0] for k in lamps)])
            points.append(image(poses[c], xyz) + SIGMA_PX * rng.normal(size=(len(xyz), 2)))
            owners.append([-1] * 9 + lamps)
        info = CameraInfo(f"c{c}", WIDTH, HEIGHT, 8, RATE_HZ)
        found.append(as_detections(info, np.rint(times * 1e9).astype(np.int64), points, SIGMA_PX))
        whose.append(np.concatenate(owners).astype(int))
    return tuple(found), whose


@pytest.fixture(scope="module")
def seen(session):
    return session[0]


def test_lamps_are_told_by_what_they_blink_and_markers_are_none(session):
    seen, whose = session
    for one, owner in zip(seen, whose, strict=True):
        number = blinking(one, NUMBERS, LampSettings(1 / RATE_HZ))
        wanted = np.where(owner >= 0, np.array(NUMBERS)[owner], NO_LAMP)
        told = number != NO_LAMP
        assert (number[told] == wanted[told]).mean() > 0.99
        assert told.sum() > 0.9 * (owner >= 0).sum()


def test_a_number_that_nobody_shows_is_not_found(seen):
    assert (blinking(seen[0], (20, 21, 22), LampSettings(1 / RATE_HZ)) == NO_LAMP).all()


def test_frames_too_far_apart_to_see_every_bit_are_refused(seen):
    with pytest.raises(InputError, match=r"a frame each 16\.7 ms, but lamps show a bit for 10 ms"):
        blinking(seen[0], NUMBERS, LampSettings(0.01))
    with pytest.raises(InputError, match="bit_s = 0 given"):
        LampSettings(0.0)


def exact_sights(times: np.ndarray) -> LampRays:
    rays = np.full((len(times), 3, 3, 3), np.nan)
    for i, t in enumerate(times):
        poses = [pose_of(c, t) for c in range(3)]
        for v in range(3):
            for j in range(3):
                if v != j:
                    way = (poses[j].transform(LAMP_M[j][None])[0] - poses[v].translation) @ poses[v].rotation
                    rays[i, v, j] = way / np.linalg.norm(way)
    return LampRays(times, rays)


KNOWN = np.array([True, True, False])


def test_sightings_of_lamps_alone_place_a_camera_exactly():
    times = np.linspace(0.0, 1.0, 7)
    placed = poses_from_lamps(exact_sights(times), rig(known_pose=False), KNOWN, LAMP_M)
    for i, t in enumerate(times):
        true = pose_of(2, t)
        np.testing.assert_allclose(placed.centres[i, 2], true.translation, atol=1e-6)
        np.testing.assert_allclose(placed.rotations[i, 2], true.rotation, atol=1e-5)
    assert placed.residual_rad.max() < 1e-6


def test_a_camera_that_sees_one_lamp_alone_is_not_placed():
    """Its position is determined by two others, but its rotation about the one ray is free."""
    sights = exact_sights(np.linspace(0.0, 1.0, 5))
    sights.rays[2, 2, 1] = np.nan
    placed = poses_from_lamps(sights, rig(known_pose=False), KNOWN, LAMP_M)
    np.testing.assert_array_equal(np.isfinite(placed.centres[:, 2, 0]), [True, True, False, True, True])


def test_where_a_lamp_is_dark_its_image_is_interpolated_and_nowhere_beyond(session):
    seen, whose = session
    times = [LATE_S[c] + one.frame / RATE_HZ for c, one in enumerate(seen)]
    instants = np.linspace(0.1, 1.1, 30)
    rays = lamp_rays(seen, times, whose, rig(), instants, 1 / RATE_HZ).rays
    wanted = exact_sights(instants).rays
    assert np.isfinite(rays[:, 0, 2, 0]).mean() > 0.9
    # 0.05 px are 0.0002 rad; where a lamp was dark for three bits the cubic is off by more
    away = np.linalg.norm(rays - wanted, axis=3)[:, ~np.eye(3, dtype=bool)]
    assert np.nanmedian(away) < 1e-3
    assert np.nanmax(away) < 0.02
    none = lamp_rays(seen, times, [np.full(len(w), -1) for w in whose], rig(), instants, 1 / RATE_HZ)
    assert np.isnan(none.rays).all()


class _Swing:
    cameras = ("c0", "c1", "c2")

    def at(self, time_s):
        poses = [[pose_of(c, t) for c in range(3)] for t in time_s]
        return (
            np.array([[p.rotation for p in row] for row in poses]),
            np.array([[p.translation for p in row] for row in poses]),
        )


def test_images_of_a_moving_camera_are_taken_where_it_is():
    times = np.array([0.2, 0.7])
    xyz = np.array([markers(t) for t in times])
    found = images_at(rig().cameras[2], 2, _Swing(), times, xyz)
    for i, t in enumerate(times):
        np.testing.assert_allclose(found[i], image(pose_of(2, t), xyz[i]), atol=1e-6)


def test_a_rig_that_moves_is_there_only_near_where_it_was_told():
    moving = MovingRig(rig(), _Swing(), (np.array([0.0, 1.0]), np.array([0.5]), np.empty(0)), 0.1)
    there = moving.there(np.array([0.05, 0.45, 0.95]))
    np.testing.assert_array_equal(there, [[True, False, False], [False, True, False], [True, False, False]])
    rigs = moving.rigs(np.array([0.3]))
    np.testing.assert_allclose(rigs[0].cameras[2].world_from_camera.translation, pose_of(2, 0.3).translation)


# all images are drawn alike, however far the marker is
GATHERING = AssociationSettings(PipelineSettings(match=MatchSettings(judge_sizes=False)))
SETTINGS = ContinuousSettings(limbs=False, knot_s=0.033)


def test_markers_and_the_camera_on_a_limb_come_out_of_images_alone(seen):
    worn = solve_worn(
        seen, rig(known_pose=False), ("c0", "c1"), Lamps(NUMBERS, LAMP_M, 1 / RATE_HZ), GATHERING, SETTINGS
    )
    found = worn.reconstructed
    assert len(found.estimated.curves.points) == 9
    instants = np.linspace(0.2, 1.1, 10)
    places = found.estimated.curves.at(instants)
    for i, t in enumerate(instants):
        away = np.linalg.norm(places[i][:, None] - markers(t)[None], axis=2).min(axis=1)
        # 0.05 px of 235 px/rad at 0.8 m are 0.2 mm a ray
        assert np.sqrt((away**2).mean()) < 0.0005
    rotations, centres = found.cameras.at(instants)
    for i, t in enumerate(instants):
        assert np.linalg.norm(centres[i, 2] - pose_of(2, t).translation) < 0.001
        turned = Rotation.from_matrix(rotations[i, 2].T @ pose_of(2, t).rotation).magnitude()
        assert turned < 0.002
    assert worn.lamp_rms_px < 0.1


def test_lamps_taken_for_others_are_refused(seen):
    """The control: with wrong lamp numbers no camera gets a pose."""
    with pytest.raises(InputError, match="camera 'c2': lamps tell at 0 instants where it is"):
        solve_worn(
            seen, rig(known_pose=False), ("c0", "c1"), Lamps((20, 21, 22), LAMP_M, 1 / RATE_HZ), GATHERING, SETTINGS
        )


def test_one_camera_of_known_place_is_too_few(seen):
    with pytest.raises(InputError, match="1 of known place given; two at least"):
        solve_worn(seen, rig(), ("c0",), Lamps(NUMBERS, LAMP_M, 1 / RATE_HZ), GATHERING, SETTINGS)
    with pytest.raises(InputError, match="each lamp needs a number of its own"):
        Lamps((1, 1, 2), LAMP_M, 0.025)
