"""A recorded person seen by three free-running cameras: how near the curves come to what such knots can hold."""

import numpy as np
import pytest
from continuous_scenes import ring, rms, take
from scipy.interpolate import make_lsq_spline

from mosca.continuous.estimator.estimate import ContinuousSettings, estimate
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.motion import forward_kinematics


def jump(data_dir, frames, joints=None):
    """The standing long jump's joints at ``frames`` of 120 Hz, coinciding ones once; ``joints`` of them."""
    file = data_dir / "cmu_mocap" / "bvh" / "13" / "13_11.bvh"
    motion = read_bvh(file, metres_per_unit=0.0104, frame_rate_hz=120.0, drop_frames=1)
    xyz = forward_kinematics(motion)[0][frames]
    distinct: list[int] = []
    for k in range(xyz.shape[1]):
        if all(np.abs(xyz[:, k] - xyz[:, other]).max() > 1e-3 for other in distinct):
            distinct.append(k)
    if joints is not None:
        distinct = [distinct[k] for k in np.linspace(0, len(distinct) - 1, joints).astype(int)]
    return xyz[:, distinct] - xyz[:, distinct].mean(axis=(0, 1))


def seen(xyz):
    """What three cameras see, each every ninth frame, three apart; the truth, its times and its floor."""
    time = np.arange(len(xyz)) / 120

    def path(t):
        return xyz[np.round(np.asarray(t) * 120).astype(int)]

    # hardly any noise: its stated size only keeps the equations regular
    observations = take(path, ring(away=4.5), [time[3 * c :: 9] for c in range(3)], 0.02)
    places = np.concatenate([[0] * 3, np.linspace(0, time[-1], round(time[-1] / 0.025) + 1), [time[-1]] * 3])
    best = make_lsq_spline(time, xyz.reshape(len(xyz), -1), places, 3)(time).reshape(xyz.shape)
    return observations, path, time[6:-9], np.sqrt(((best - xyz) ** 2).sum(axis=2).mean())


@pytest.mark.slow
@pytest.mark.data
def test_a_jump_is_within_twice_the_floor_and_limbs_and_company_help(data_dir):
    observations, path, within, floor = seen(jump(data_dir, slice(300)))
    ours = rms(estimate(observations, ring(away=4.5)), path, within)
    assert ours < 2.0 * floor
    assert ours < rms(estimate(observations, ring(away=4.5), ContinuousSettings(limbs=False)), path, within)


@pytest.mark.data
def test_few_markers_in_the_jump_itself_are_near_the_floor_and_limbs_help(data_dir):
    """Fifteen joints have less company."""
    observations, path, within, floor = seen(jump(data_dir, slice(120, 312), 15))
    ours = rms(estimate(observations, ring(away=4.5)), path, within)
    assert ours < 2.5 * floor
    assert ours < rms(estimate(observations, ring(away=4.5), ContinuousSettings(limbs=False)), path, within)
