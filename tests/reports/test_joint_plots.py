"""Pictures of joint angles: what they say in words, and curves where they belong."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from mosca.data.joint_angles import JointAngles
from reports.joint_plots import CYCLE_PERCENT, _curve, angles_picture

NAMES = tuple(f"{side}_{name}" for name in ("hip_flexion", "hip_adduction", "knee_flexion") for side in "lr")


def walking(error_deg: float = 2.0) -> tuple[JointAngles, JointAngles, dict[str, np.ndarray]]:
    """Return angles of 4.5 strides of 1.2 s, the truth ``error_deg`` below them, and the heel strikes."""
    start, t = 1_790_000_000_000_000_000, np.arange(540) / 100
    phase = 2 * np.pi * t / 1.2
    true = np.stack([0.3 + 0.2 * np.sin(phase + k) for k in range(len(NAMES))] + [0.1 * np.sin(2 * phase)], axis=1)
    time_ns = start + (1e9 * t).astype(np.int64)
    names = (*NAMES, "pelvis_tilt")
    measured = JointAngles(np.arange(540), time_ns, names, true + np.deg2rad(error_deg), np.full(true.shape, 0.02))
    strikes = {side: start + 10**6 * np.arange(first, 5400, 1200) for side, first in (("l", 300), ("r", 900))}
    return measured, JointAngles(np.arange(540), time_ns, names, true, 0 * true), strikes


@pytest.mark.parametrize("cycles", [False, True])
def test_a_picture_says_what_it_shows(cycles: bool) -> None:
    angles, truth, strikes = walking()
    picture = angles_picture(angles, truth, strikes if cycles else None)
    over = ", 4 gait cycles" if cycles else ""
    assert picture.alt == f"7 joint angles over 5.39 s{over}; 2 deg rms from the truth."
    root = ElementTree.fromstring(re.sub(r"<!--.*?-->", "", picture.svg))
    words = " ".join(text.strip() for text in root.itertext() if text.strip())
    for part in ("left hip flexion", "right knee flexion", "pelvis tilt", "gait cycle [%]" if cycles else "time [s]"):
        assert part in words
    assert ("heel strike" in picture.caption) == cycles
    assert "1.79e9" not in words
    assert picture == angles_picture(angles, truth, strikes if cycles else None)
    assert "truth" not in angles_picture(angles).alt + angles_picture(angles).caption


def test_cycles_are_those_between_strikes() -> None:
    angles, _, strikes = walking(error_deg=0.0)
    for name, first in (("l_knee_flexion", 0.3), ("r_knee_flexion", 0.9), ("pelvis_tilt", 0.9)):
        curve = _curve(angles, name, strikes, angles.time_ns[0])
        k = angles.names.index(name)
        phase = 2 * np.pi * (first / 1.2 + CYCLE_PERCENT / 100)
        wanted = 0.1 * np.sin(2 * phase) if name == "pelvis_tilt" else 0.3 + 0.2 * np.sin(phase + k)
        assert len(curve.cycles) == (4 if first < 0.5 else 3)
        np.testing.assert_allclose(curve.cycles, np.tile(np.rad2deg(wanted), (len(curve.cycles), 1)), atol=0.01)
        np.testing.assert_allclose(curve.sigma, np.rad2deg(0.02))


def test_gaps_and_too_few_strikes_are_drawn_as_nothing() -> None:
    angles, _, strikes = walking()
    values = angles.angles.copy()
    values[100:110, 0] = np.nan
    gappy = JointAngles(angles.frame, angles.time_ns, angles.names, values, angles.sigma)
    assert np.isnan(_curve(gappy, angles.names[0], strikes, angles.time_ns[0]).cycles).any(axis=1).tolist() == [
        True,
        False,
        False,
        False,
    ]
    few = {"l": strikes["l"][:1]}
    assert np.isnan(_curve(gappy, "r_hip_flexion", few, angles.time_ns[0]).mean).all()
    assert "0 gait cycles" in angles_picture(gappy, None, few).alt
    with pytest.raises(ValueError, match="none to draw"):
        angles_picture(JointAngles([], [], (), np.empty((0, 0)), np.empty((0, 0))))
