"""Heel strikes from joints in motion: a foot is farthest in front of the pelvis when it meets the floor.

Zeni, Richards & Higginson 2008 (Gait & Posture 27:710): heel strikes are maxima over time of the forward distance of
the heel from the sacrum, on a treadmill and overground. Here the pelvis' centre replaces the sacrum: their distance
is fixed and moves no maximum. The ankle's centre replaces the heel where no heel markers are given. Forward is the
pelvis' x axis, level with the floor, so that it turns with the subject. Against force plates (250 Hz, two takes of
OpenSim's test data, contact at 20 N) strikes came 13 to 20 ms early, by ankles and by heels.
"""

from collections.abc import Mapping

import numpy as np

from mosca.data.arrays import Array
from mosca.data.joint_motion import JointMotion
from mosca.data.motion.motion import matrices_from_quaternions
from mosca.errors import InputError

_TOP = 0.1
"""Share of a maximum's height over its valleys within which a parabola is fitted; for a cosine +-37 deg of phase."""


def heel_strikes(
    motion: JointMotion, heels: Mapping[str, Array] | None = None, *, least_swing: float = 0.2
) -> dict[str, Array]:
    """Return the instants (k,) [ns] of the heel strikes of each foot, "l" and "r", in order.

    Frames in which pelvis or heel is unknown are skipped. A strike in the first or last half stride may be missed,
    since a maximum needs a valley on both sides. Raises InputError where there is no pelvis, or neither ankle nor
    heel.

    Parameters
    ----------
    motion
        With ``pelvis``, and ``l_ankle`` and ``r_ankle`` where ``heels`` has none of that side.
    heels
        Side -> path (n, 3) [m] of a marker on the heel in the frames of ``motion``, NaN where unknown.
    least_swing
        How far a foot must swing relative to the pelvis, forth and back, as a share of its mean distance from the
        pelvis. Healthy steps are 0.7 to 0.9 of this distance; at 0.1 shuffling in place counts too, at 0.4 short
        steps of patients are missed.
    """
    if "pelvis" not in motion.joints:
        raise InputError(
            f"heel strikes: no pelvis among the joints {', '.join(motion.joints)}; it says what is forward"
        )
    pelvis = motion.joints.index("pelvis")
    forward = matrices_from_quaternions(motion.rotation[:, pelvis])[:, :, 0] * [1.0, 1.0, 0.0]
    strikes = {}
    for side in "lr":
        heel = (heels or {}).get(side)
        if heel is None:
            if f"{side}_ankle" not in motion.joints:
                raise InputError(f"heel strikes: neither {side}_ankle among the joints nor a heel marker; give one")
            heel = motion.centre[:, motion.joints.index(f"{side}_ankle")]
        apart = heel - motion.centre[:, pelvis]
        with np.errstate(invalid="ignore"):
            ahead = np.sum(apart * forward, axis=1) / np.linalg.norm(forward, axis=1)
        known = np.isfinite(ahead)
        leg = float(np.mean(np.linalg.norm(apart[known], axis=1))) if known.any() else 0.0
        strikes[side] = _maxima(motion.time_ns[known], ahead[known], least_swing * leg)
    return strikes


def _maxima(time_ns: Array, ahead: Array, least: float) -> Array:
    """Return when ``ahead`` (n,) [m] is largest, for maxima at least so far above the valleys beside them."""
    from scipy.signal import find_peaks  # takes a second to import

    peaks, found = find_peaks(ahead, prominence=max(least, 1e-9))
    times = []
    for peak, height in zip(peaks.tolist(), found["prominences"].tolist(), strict=True):
        low = ahead < ahead[peak] - _TOP * height
        before, after = np.flatnonzero(low[:peak]), np.flatnonzero(low[peak:])
        top = slice(int(before[-1]) + 1, peak + int(after[0]))
        t = 1e-9 * (time_ns[top] - time_ns[peak])
        place = 0.0
        if len(t) > 2:
            # noise decides which sample of a flat top is the highest; a fit to all of them is more accurate
            a, b, _ = np.polyfit(t, ahead[top], 2)
            place = float(np.clip(-b / (2 * a), t[0], t[-1])) if a < 0 else 0.0
        times.append(int(time_ns[peak]) + round(1e9 * place))
    return np.array(times, dtype=np.int64)
