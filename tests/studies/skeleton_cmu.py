"""Markers held out of the skeleton's fit and predicted, on a real take (CMU 02_01), beside Vicon's own solve.

Run: ``python -m tests.studies.skeleton_cmu [--all | --markers LABEL ...] [--frames N]``; data: ``$MOSCA_DATA``. Each
marker in turn is left out, the skeleton fitted to the others (N frames, evenly spread) and their poses found in all
frames. The mean place of the marker on its body is learned in every other block of 0.1 s; in the other blocks it is
predicted. So the error holds the pose's error and the skin's movement, and a pose that overfits gains nothing.

Vicon's skeleton and solve (02.asf, 02_01.amc) had the marker when they were solved; each marker's offset is learned
and tested in the same way on the bone to which it is nearest to fixed.
"""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from mosca.data.arrays import Array
from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.motion import WORLD_FROM_Y_UP, forward_kinematics
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.skeleton.fit import fit_subject
from mosca.skeleton.marker_frames import MarkerFrames, labels_of, marker_frames
from mosca.skeleton.model import HUMAN, read_skeleton_model
from mosca.skeleton.track import SkeletonTracker

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
BLOCK_S = 0.1
"""Short against a stride (1.1 s): blocks of half a stride would learn in one phase of it and test in the other."""
VICON_METRES_PER_UNIT = 0.0564444
WORLD_FROM_ASF = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""The take's axes are a permutation of the file's: x, y, z of the take are z, x, y of the ASF file."""
QUICK = ("LFHD", "RELB", "RTHI", "LKNE", "RTOE", "T10")
"""One marker of each part of the body."""


def take(folder: Path) -> MarkerFrames:
    """Return all markers of the take in ``folder``, the data's."""
    tracks = read_tracks(folder / "people" / "cmu_02_01.c3d")
    return marker_frames(tracks, labels_of(tracks))


def held_out_m(frames: MarkerFrames, label: str, fitted: int) -> Array:
    """Return the distances (k,) [m] of ``label`` from where the others predict it, in the blocks not learned from."""
    others = [k for k, other in enumerate(frames.labels) if other != label]
    model = read_skeleton_model(HUMAN, [frames.labels[k] for k in others])
    columns = [frames.labels.index(other) for other in model.labels]
    seen = MarkerFrames(
        model.labels, frames.frame, frames.time_ns, frames.xyz[:, columns], frames.covariance[:, columns]
    )
    chosen = np.unique(np.linspace(0, len(frames) - 1, fitted).round().astype(int))
    tracker = SkeletonTracker(fit_subject(model, seen.select(chosen), label))
    mj = mujoco.MjModel.from_xml_string(model.mjcf)
    body = int(mj.site_bodyid[mj.site(label).id])
    origin, rotation = np.full((len(frames), 3), np.nan), np.full((len(frames), 3, 3), np.nan)
    for k in range(len(frames)):
        if tracker.step(seen.xyz[k], seen.covariance[k]) is not None:
            origin[k], rotation[k] = (
                tracker.kinematics.joint_centres()[body - 1],
                tracker.kinematics.rotations()[body],
            )
    return predicted_m(frames, label, origin, rotation)


def predicted_m(frames: MarkerFrames, label: str, origin: Array, rotation: Array, *, learning: bool = False) -> Array:
    """Return distances (k,) [m] of ``label`` from its mean place on a body.

    ``origin`` (n, 3) [m] and ``rotation`` (n, 3, 3) are the body's, NaN where not found. The place is
    the mean over every other block; distances are those in the rest, or, ``learning``, in these.
    """
    xyz = frames.xyz[:, frames.labels.index(label)]
    block = (frames.time_ns - frames.time_ns[0]) // round(1e9 * BLOCK_S)
    known = np.isfinite(xyz[:, 0]) & np.isfinite(origin[:, 0])
    local = np.einsum("nki,nk->ni", rotation, xyz - origin)
    place = local[known & (block % 2 == 0)].mean(axis=0)
    return np.asarray(np.linalg.norm(local - place, axis=1)[known & (block % 2 == (0 if learning else 1))])


def vicon_m(frames: MarkerFrames, folder: Path) -> dict[str, Array]:
    """Return label -> distances (k,) [m] as ``held_out_m`` does, from Vicon's solve with that marker."""
    files = folder / "cmu_mocap" / "asfamc" / "02"
    motion = read_asf_amc(files / "02.asf", files / "02_01.amc", metres_per_unit=VICON_METRES_PER_UNIT)
    turn = WORLD_FROM_ASF @ WORLD_FROM_Y_UP.T
    places, rotations = forward_kinematics(motion)
    places, rotations = places @ turn.T, turn @ rotations
    found = {}
    for label in frames.labels:
        bones = [(places[:, j], rotations[:, j]) for j in range(places.shape[1])]
        fixed = [float(np.mean(predicted_m(frames, label, *bone, learning=True) ** 2)) for bone in bones]
        found[label] = predicted_m(frames, label, *bones[int(np.argmin(fixed))])
    return found


def summary_mm(errors: Sequence[Array]) -> tuple[float, float, float]:
    """Return the median and rms over all samples, and the median of the markers' own rms [mm]."""
    every = 1e3 * np.concatenate(errors)
    own = [1e3 * float(np.sqrt(np.mean(error**2))) for error in errors]
    return float(np.median(every)), float(np.sqrt(np.mean(every**2))), float(np.median(own))


def main() -> None:
    """Print a line for each marker and the summary."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--all", action="store_true", help="each of the 41 markers")
    parser.add_argument("--markers", nargs="+", default=list(QUICK))
    parser.add_argument("--frames", type=int, default=58, help="frames of the fit")
    given = parser.parse_args()
    frames = take(DATA)
    theirs = vicon_m(frames, DATA)
    ours = {}
    for label in frames.labels if given.all else given.markers:
        ours[label] = held_out_m(frames, label, given.frames)
        cells = "  ".join(
            f"{summary_mm([one[label]])[0]:6.2f} {summary_mm([one[label]])[1]:6.2f}" for one in (ours, theirs)
        )
        print(f"{label:6} median, rms mm: held out, and Vicon's own  {cells}", flush=True)
    for name, one in (("held out", ours), ("Vicon's", theirs)):
        print(
            "{}: median {:.2f} mm, rms {:.2f} mm, median of markers' rms {:.2f} mm".format(
                name, *summary_mm([one[label] for label in ours])
            )
        )


if __name__ == "__main__":
    main()
