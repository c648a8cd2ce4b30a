"""A person fitted to a range of motion, then followed in other movements: errors of joints and what was stated.

Run: ``python -m tests.studies.skeleton_people [--skins off moderate strong] [--actions ACTION ...] [--seeds N]``.
The actor's 53 anatomical markers, 5 mm from where they should sit, 0.3 mm of noise a coordinate, no cameras. Rms over
joints, frames and seeds of the centres' distance [mm] and of the rotation vectors' components [deg]; nees is 3, and
coverage 0.95, where the stated covariances are right.
"""

import argparse

import numpy as np
from scipy.stats import chi2

from mosca.data.arrays import Array
from mosca.data.joint_motion import JointMotion
from mosca.skeleton.fit import fit_subject
from mosca.skeleton.track import track_subject
from tests.studies.skeleton_actor import Truth, actor_take, apart, rms

WORN = {"marker_set": "anatomical", "seat_sigma_m": 0.005}
MOVEMENT_S, TAKE_S, RATE_HZ = 24.0, 10.0, 10.0
INSIDE = float(chi2.ppf(0.95, 3))


def errors(joints: JointMotion, truth: Truth) -> tuple[Array, Array, Array, Array]:
    """Return the centres' errors (k, 3) [m] and their squares by the covariance (k,), then the rotations'."""
    found: list[Array] = []
    for away, covariance in zip(
        apart(joints, truth), (joints.centre_covariance, joints.rotation_covariance), strict=True
    ):
        known = np.isfinite(away[..., 0]) & np.isfinite(covariance[..., 0, 0])
        error = away[known]
        found += [error, np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance[known]), error)]
    distance, nees, turn, turn_nees = found
    return distance, nees, turn, turn_nees


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--skins", nargs="+", default=["off", "moderate", "strong"])
    parser.add_argument("--actions", nargs="+", default=["walk", "boxing", "dance", "jump"])
    parser.add_argument("--seeds", type=int, default=3)
    given = parser.parse_args()
    print("skin      action   centre mm  nees  cover   angle deg  nees  cover")
    for skin in given.skins:
        subjects = []
        for seed in range(1, given.seeds + 1):
            model, frames, _ = actor_take("range_of_motion", MOVEMENT_S, RATE_HZ, seed, skin=skin, **WORN)
            subjects.append(fit_subject(model, frames))
        for action in given.actions:
            parts = []
            for seed, subject in enumerate(subjects, 1):
                _, frames, truth = actor_take(action, TAKE_S, RATE_HZ, seed, skin=skin, **WORN)
                parts.append(errors(track_subject(subject, frames).joints, truth))
            distance, nees, turn, turn_nees = (np.concatenate(one) for one in zip(*parts, strict=True))
            print(
                f"{skin:9} {action:8} {1e3 * rms(np.linalg.norm(distance, axis=1)):9.2f} {nees.mean():5.1f} "
                f"{(nees < INSIDE).mean():6.3f} {np.rad2deg(rms(turn.ravel())):11.2f} {turn_nees.mean():5.1f} "
                f"{(turn_nees < INSIDE).mean():6.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
