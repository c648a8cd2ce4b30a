"""Two calibrations compared: known differences are recovered."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import ring
from scipy.spatial.transform import Rotation

from mosca.calibration.common.robust_fit import similarity
from mosca.calibration.quality.compare_rigs import compare_rigs
from mosca.data.rig import Pose, Rig
from mosca.errors import InputError

RIG = Rig(tuple(ring(4)))


def carried(rig: Rig, scale: float, motion: Pose) -> Rig:
    return Rig(
        tuple(
            replace(
                c,
                world_from_camera=Pose(
                    motion.rotation @ c.world_from_camera.rotation,
                    scale * motion.rotation @ c.world_from_camera.translation + motion.translation,
                ),
            )
            for c in rig.cameras
        )
    )


def changed(rig: Rig, index: int, pose=None, **lens) -> Rig:
    cameras = list(rig.cameras)
    one = cameras[index]
    cameras[index] = replace(one, lens=replace(one.lens, **lens), world_from_camera=pose or one.world_from_camera)
    return Rig(tuple(cameras))


def test_a_rig_is_like_itself():
    same = compare_rigs(RIG, RIG)
    assert same.rms_m < 1e-12
    assert all(one.rms_px < 1e-9 and one.lens_rms_px < 1e-9 for one in same.cameras)


def test_a_common_similarity_is_removed_and_told():
    motion = Pose(Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([1.0, 2.0, -0.5]))
    found = compare_rigs(carried(RIG, 1.01, motion), RIG)
    assert found.scale == pytest.approx(1.01, abs=1e-9)
    assert np.allclose(found.motion.rotation, motion.rotation, atol=1e-9)
    assert found.rms_m < 1e-9
    assert found.before_rms_m > 1.0
    assert max(one.rms_px for one in found.cameras) < 1e-6
    rigid = compare_rigs(carried(RIG, 1.01, motion), RIG, align="rigid")
    # 1 % of a cube of edge e: each coordinate is uniform on a 7-point grid, rms = 0.01 e / 2 sqrt(4/9) sqrt(3)
    edge = float((rigid.volume[1] - rigid.volume[0])[0])
    assert rigid.rms_m == pytest.approx(0.01 / 1.01 * edge / 2 * np.sqrt(4 / 9 * 3), rel=0.02)


def test_a_principal_point_shift_is_its_own_size():
    found = compare_rigs(RIG, changed(RIG, 1, cx_px=RIG.cameras[1].lens.cx_px + 0.5), align="none")
    assert found.cameras[1].rms_px == pytest.approx(0.5, rel=1e-6)
    assert found.cameras[0].rms_px < 1e-9
    # a shift and a rotation are nearly alike
    assert found.cameras[1].lens_rms_px < 0.15


def test_a_turned_camera():
    pose = RIG.cameras[2].world_from_camera
    turn = Rotation.from_rotvec([0, 1e-3, 0]).as_matrix()
    found = compare_rigs(RIG, changed(RIG, 2, Pose(pose.rotation @ turn, pose.translation)), align="none")
    one = found.cameras[2]
    assert one.turn_rad == pytest.approx(1e-3, rel=1e-6)
    assert one.lens_rms_px < 1e-6
    # f (1 + tan^2) by the angle: a little more than 1.01 px
    assert 1.0 < one.rms_px < 1.5
    assert found.rms_m > 1e-4


def test_a_centre_along_the_ray_is_no_difference_in_the_middle():
    pose = RIG.cameras[0].world_from_camera
    back = Pose(pose.rotation, pose.translation - 0.01 * pose.rotation[:, 2])
    found = compare_rigs(RIG, changed(RIG, 0, back), align="none")
    assert found.cameras[0].centre_m == pytest.approx(0.01)
    # 1 cm of 3 m along the axis; at the corner, 39 deg off it, of 3 cos(39 deg) m: 820 px / 233
    assert found.cameras[0].max_px == pytest.approx(820 / 233, rel=0.05)


def test_lines_are_text():
    lines = compare_rigs(RIG, changed(RIG, 1, cx_px=640.5)).lines()
    assert len(lines) == 2 + 4 + 2
    assert all(line.isprintable() for line in lines)
    assert "in the volume" in lines[-2]


def test_similarity_recovers_what_was_put_in():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(20, 3))
    motion = Pose(Rotation.from_rotvec([1, -2, 0.5]).as_matrix(), np.array([3.0, 2, 1]))
    scale, found = similarity(points, motion.transform(0.7 * points))
    assert scale == pytest.approx(0.7)
    assert np.allclose(found.rotation, motion.rotation)
    assert np.allclose(found.translation, motion.translation)


def test_rigs_without_a_common_camera_and_of_other_sizes():
    other = Rig(tuple(replace(c, name="x" + c.name) for c in RIG.cameras))
    with pytest.raises(InputError, match="no camera is in both"):
        compare_rigs(RIG, other)
    small = Rig((replace(RIG.cameras[0], width=640), *RIG.cameras[1:]))
    with pytest.raises(InputError, match="compare calibrations made at one size"):
        compare_rigs(RIG, small)
    with pytest.raises(InputError, match="align"):
        compare_rigs(RIG, RIG, align="affine")


def test_one_camera_alone_compares_its_lens():
    one = Rig(RIG.cameras[:1])
    found = compare_rigs(one, changed(one, 0, fx_px=1001.0, fy_px=1004.0))
    assert found.n_points == 0
    assert 0.2 < found.cameras[0].lens_rms_px < 0.7
    assert "no point" in found.lines()[-1]
