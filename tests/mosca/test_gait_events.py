"""Heel strikes of a closed-form gait whose strikes are known."""

import os
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from joint_scenes import motion_of, wxyz
from scipy.spatial.transform import Rotation

from mosca.data.joint_motion import JointMotion
from mosca.errors import InputError
from mosca.skeleton.gait_events import heel_strikes

RATE_HZ, STRIDE_S, LEG_M = 100.0, 1.1, 0.85
UPRIGHT = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def gait(
    step_m: float = 0.65, noise_m: float = 0.0, turn_rad_s: float = 0.0, seconds: float = 11.7
) -> tuple[JointMotion, dict[str, np.ndarray]]:
    """Return a walk and its strikes [ns]: the feet go slower backward than forward and are foremost at the strikes.

    A foot is step / 2 * cos(psi) before the pelvis, psi = p + 0.4 sin(p - 0.7) + 0.4 sin(0.7) of the phase p:
    0 where p is 0, once a stride.
    """
    rng = np.random.default_rng(2)
    t = np.arange(0, seconds, 1 / RATE_HZ)
    n = len(t)
    # towards the world's y first
    heading = np.pi / 2 + turn_rad_s * t
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros(n)], axis=1)
    centre = np.zeros((n, 3, 3))
    centre[:, 0] = np.cumsum(1.2 / RATE_HZ * ahead, axis=0) + [0, 0, 0.9]
    strikes = {}
    for k, (side, first) in enumerate((("l", 0.4), ("r", 0.4 + STRIDE_S / 2))):
        phase = 2 * np.pi * (t - first) / STRIDE_S
        psi = phase + 0.4 * np.sin(phase - 0.7) + 0.4 * np.sin(0.7)
        centre[:, 1 + k] = centre[:, 0] + step_m / 2 * np.cos(psi)[:, None] * ahead - [0, 0, LEG_M]
        strikes[side] = 1e9 * np.arange(first, seconds, STRIDE_S)
    centre += rng.normal(0, noise_m, centre.shape)
    pelvis = Rotation.from_euler("z", heading[:, None]) * UPRIGHT
    still = Rotation.identity(n)
    return motion_of({"pelvis": pelvis, "l_ankle": still, "r_ankle": still}, centre=centre), strikes


@pytest.mark.parametrize(
    ("noise_m", "turn_rad_s", "most_ms"), [(0, 0, 6), (0, 0.3, 6), (0.003, 0, 12), (0.003, 0.3, 12)]
)
def test_strikes_of_a_closed_form_gait(noise_m: float, turn_rad_s: float, most_ms: float) -> None:
    motion, true = gait(noise_m=noise_m, turn_rad_s=turn_rad_s)
    found = heel_strikes(motion)
    for side in "lr":
        assert found[side].dtype == np.int64
        assert len(found[side]) == len(true[side])
        assert np.abs(found[side] - true[side]).max() < 1e6 * most_ms


def test_gaps_and_heel_markers() -> None:
    motion, true = gait()
    centre = motion.centre.copy()
    centre[300:305] = np.nan
    gappy = JointMotion(**{**vars(motion), "centre": centre})
    heels = {"l": gappy.centre[:, 1] + [0, -0.05, -0.05], "r": gappy.centre[:, 2] + [0, -0.05, -0.05]}
    for found in (heel_strikes(gappy), heel_strikes(gappy, heels)):
        for side in "lr":
            assert len(found[side]) == len(true[side])
            assert np.abs(found[side] - true[side]).max() < 12e6


def test_who_stands_or_shuffles_has_no_strikes() -> None:
    for step, least, strides in (
        (0.0, 0.2, 0),
        (0.12, 0.2, 0),
        (0.12, 0.1, 11),
        (0.25, 0.2, 11),
        (0.25, 0.4, 0),
        (0.65, 0.4, 11),
    ):
        found = heel_strikes(gait(step_m=step, noise_m=0.003)[0], least_swing=least)
        assert len(found["l"]) == strides


def test_what_is_missing() -> None:
    motion, _ = gait(seconds=1.0)
    with pytest.raises(InputError, match="no pelvis among the joints l_ankle"):
        heel_strikes(motion_of({"l_ankle": Rotation.identity(3)}))
    with pytest.raises(InputError, match="neither r_ankle among the joints nor a heel marker"):
        heel_strikes(motion_of({"pelvis": UPRIGHT * Rotation.identity(3), "l_ankle": Rotation.identity(3)}))
    unknown = JointMotion(
        **{**vars(motion), "rotation": np.full_like(wxyz(Rotation.identity(300)).reshape(100, 3, 4), np.nan)}
    )
    assert [len(times) for times in heel_strikes(unknown).values()] == [0, 0]


TAKES = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "c3d_trc" / "opensim"


@pytest.mark.data
@pytest.mark.parametrize("take", ["walking5", "test_walking"])
def test_strikes_against_a_force_plate(take: str) -> None:
    """The one contact in each take whose heel lands inside a plate; Zeni 2008 found errors of 1 frame at 60 Hz."""
    path = TAKES / f"{take}.c3d"
    if not path.is_file():
        pytest.skip(f"needs {path} of MOSCA_DATA")
    document = ezc3d.c3d(str(path))
    labels = document["parameters"]["POINT"]["LABELS"]["value"]
    xyz = 1e-3 * document["data"]["points"][:3].transpose(2, 1, 0)
    front, back = (xyz[:, [labels.index(f"{s}{bone}") for s in "LR"]].mean(axis=1) for bone in ("ASI", "PSI"))
    forward = np.nan_to_num((front - back) * [1, 1, 0], nan=1.0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up = np.tile([0, 0, 1.0], (len(xyz), 1))
    pelvis = Rotation.from_matrix(np.stack([forward, up, np.cross(forward, up)], axis=2))
    heel = {side: xyz[:, labels.index(f"{side.upper()}CAL")] for side in "lr"}
    ankle = {side: xyz[:, labels.index(f"{side.upper()}AJC")] for side in "lr"}
    still = Rotation.identity(len(xyz))
    motion = motion_of(
        {"pelvis": pelvis, "l_ankle": still, "r_ankle": still},
        centre=np.stack([(front + back) / 2, ankle["l"], ankle["r"]], axis=1),
        time_ns=4_000_000 * np.arange(len(xyz)),
    )
    plates = document["parameters"]["FORCE_PLATFORM"]["CORNERS"]["value"].transpose(2, 1, 0)
    tried = 0
    for corners, channel in zip(1e-3 * plates, (2, 8), strict=True):
        force_n = document["data"]["analogs"][0, channel]
        contact = int(np.flatnonzero(np.abs(force_n - np.median(force_n)) > 20)[0])  # 8 samples a frame
        for side, path_of in heel.items():
            x, y, _ = path_of[contact // 8].T
            # a heel is 50 mm behind its marker at most
            inside = (corners[:, 0].min() + 0.05 < x < corners[:, 0].max()) and corners[:, 1].min() < y < corners[
                :, 1
            ].max()
            if not inside:
                continue
            tried += 1
            for strikes in (heel_strikes(motion), heel_strikes(motion, heel)):
                late_ms = 1e-6 * strikes[side] - contact / 2.0
                assert np.abs(late_ms).min() < 1000 / 60 + 4
    assert tried == 1
