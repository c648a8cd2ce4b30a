"""Joint centres as tracks, which all files of tracks hold: CSV, NPZ, TRC, C3D."""

import numpy as np

from mosca.data.joint_motion import JointMotion
from mosca.data.tracks import Tracks


def centres_as_tracks(motion: JointMotion) -> Tracks:
    """Return the known centres, one track a joint: its label is the joint's name, its number its place in the order.

    ``n_cameras`` is 0 and ``residual_px`` NaN: no camera sees a joint's centre.
    """
    row, joint = np.nonzero(np.isfinite(motion.centre).all(axis=2))
    n = len(row)
    return Tracks(
        frame=motion.frame[row],
        time_ns=motion.time_ns[row],
        track=joint,
        label=np.array(motion.joints, dtype=np.str_)[joint] if n else np.empty(0, dtype=np.str_),
        xyz=motion.centre[row, joint],
        covariance=motion.centre_covariance[row, joint],
        n_cameras=np.zeros(n, dtype=np.int64),
        residual_px=np.full(n, np.nan),
        status=np.full(n, "measured"),
    )
