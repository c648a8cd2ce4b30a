"""Hip and knee flexion of a walk, ours beside a re-run of OpenSim's inverse kinematics (gait2354's subject01).

Run: ``pip install -e ".[bench]"``, ``python -m tests.studies.skeleton_gait2354 [--mot FILE]``; data: ``$MOSCA_DATA``.
OpenSim's model was scaled to the subject by its own tool and has a knee with one degree of freedom; ours is fitted to
the static and the walking trial, whose markers LABELS names ours. V.Sacral stands for both posterior superior iliac
spines; the knees' and ankles' markers are in the static trial only. An anatomical axis is a convention, so the mean
difference is told apart: rms is what remains without it. ``--mot``: a result of OpenSim instead of running it.
"""

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np

from mosca.data.arrays import Array
from mosca.data.joint_angles import JointAngles
from mosca.data.motion.motion import in_world
from mosca.formats.joints.opensim import KNEE_SIGNS
from mosca.formats.tracks.trc import read_trc
from mosca.skeleton.fit import FittedSubject, fit_subject
from mosca.skeleton.isb_angles import isb_angles
from mosca.skeleton.marker_frames import MarkerFrames
from mosca.skeleton.model import HUMAN, SkeletonModel, read_skeleton_model
from mosca.skeleton.track import track_subject

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data")) / "people" / "gait2354"
_SIDE = {
    "ASIS": "ASI",
    "Thigh.Upper": "THI",
    "Thigh.Front": "THF",
    "Thigh.Rear": "THB",
    "Knee.Lat": "KNE",
    "Knee.Med": "KNM",
    "Shank.Upper": "TIB",
    "Shank.Front": "SHN",
    "Shank.Rear": "CLF",
    "Ankle.Lat": "ANK",
    "Ankle.Med": "ANM",
    "Heel": "HEE",
    "Toe.Tip": "TOE",
    "Toe.Lat": "MT5",
    "Acromium": "SHO",
    "Bicep": "UPA",
    "Elbow": "ELB",
    "Wrist.Med": "WRA",
    "Wrist.Lat": "WRB",
    "Temple": "FHD",
}
LABELS = {
    **{f"{s}{ours}": f"{s}.{theirs}" for s in "LR" for theirs, ours in _SIDE.items()},
    **{f"{s}PSI": "V.Sacral" for s in "LR"},
    "CLAV": "Sternum",
    "ARIEL": "Top.Head",
}
"""Our label -> the trial's."""
STATIC_EVERY = 10
ANGLES = {
    **{f"hip_flexion_{s}": (f"{s}_hip_flexion", 1) for s in "rl"},
    **{f"knee_angle_{s}": (f"{s}_knee_flexion", KNEE_SIGNS["gait2354"]) for s in "rl"},
}
"""OpenSim's coordinate -> our angle and its sign."""


def trial(path: Path, model: SkeletonModel) -> MarkerFrames:
    """Return the trial in ``path`` with the model's labels, Z up; NaN for markers that it has not."""
    table = read_trc(path)
    xyz = np.full((len(table.xyz), len(model.labels), 3), np.nan)
    for k, label in enumerate(model.labels):
        if LABELS[label] in table.names:
            xyz[:, k] = in_world(table.xyz[:, table.names.index(LABELS[label])])
    n = len(xyz)
    times = np.round(np.arange(n) / table.rate_hz * 1e9).astype(np.int64)
    return MarkerFrames(model.labels, np.arange(n), times, xyz, np.zeros((n, len(model.labels), 3, 3)))


def fitted(folder: Path) -> tuple[FittedSubject, JointAngles]:
    """Return the subject and the angles of the walk in ``folder``."""
    model = read_skeleton_model(HUMAN, list(LABELS))
    walk, static = (trial(folder / f"subject01_{name}.trc", model) for name in ("walk1", "static"))
    static = static.select(np.arange(0, len(static), STATIC_EVERY))
    both = [np.concatenate(pair) for pair in ((static.xyz, walk.xyz), (static.covariance, walk.covariance))]
    n = len(both[0])
    times = np.arange(n) * int(walk.time_ns[1])
    subject = fit_subject(model, MarkerFrames(model.labels, np.arange(n), times, *both))
    return subject, isb_angles(track_subject(subject, walk).joints)


def opensim_mot(folder: Path, into: Path) -> Path:
    """Run OpenSim's inverse kinematics on the walk; return its motion file. ImportError where it is not installed."""
    import opensim

    opensim.Logger.removeFileSink()  # else it leaves opensim.log in the working folder
    opensim.Logger.setLevelString("Off")
    tool = opensim.InverseKinematicsTool(str(folder / "subject01_Setup_IK.xml"), False)
    model = opensim.Model(str(folder / "subject01_simbody.osim"))
    tool.setModel(model)
    tool.setMarkerDataFileName(str(folder / "subject01_walk1.trc"))
    tool.setOutputMotionFileName(str(into / "walk.mot"))
    tool.setResultsDir(str(into))
    if not tool.run():
        raise RuntimeError("OpenSim's inverse kinematics failed")
    return into / "walk.mot"


def read_mot(path: Path) -> dict[str, Array]:
    """Return column -> values (n,) of an OpenSim motion file; angles in degrees."""
    head, _, body = path.read_text(encoding="utf-8").partition("endheader")
    if "inDegrees=yes" not in head:
        raise ValueError(f"{path}: inDegrees=yes expected")
    lines = body.split("\n")
    names = lines[1].split()
    values = np.array([[float(cell) for cell in line.split()] for line in lines[2:] if line.strip()])
    return dict(zip(names, values.T, strict=True))


def differences_deg(angles: JointAngles, theirs: dict[str, Array]) -> dict[str, tuple[float, float, float, float]]:
    """Return coordinate -> mean difference, rms without it, range of theirs and rms of our stated sigma [deg]."""
    found = {}
    for name, (own, sign) in ANGLES.items():
        k = angles.names.index(own)
        at = np.interp(theirs["time"], 1e-9 * angles.time_ns, np.rad2deg(sign * angles.angles[:, k]))
        off = at - theirs[name]
        sigma = np.rad2deg(np.sqrt(np.nanmean(angles.sigma[:, k] ** 2)))
        found[name] = float(off.mean()), float(off.std()), float(np.ptp(theirs[name])), float(sigma)
    return found


def main() -> None:
    """Print the differences."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--mot", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        try:
            theirs = read_mot(given.mot or opensim_mot(DATA, Path(folder)))
        except ImportError as error:
            print(f"OpenSim: skipped, {error}: pip install -e '.[bench]'")
            return
    shipped = read_mot(DATA / "subject01_walk1_ik.mot")
    subject, angles = fitted(DATA)
    print(f"size {subject.size:.3f}, markers {1e3 * subject.residual_rms_m:.2f} mm rms, {subject.frames} frames")
    for title, mot in (("OpenSim, run again", theirs), ("OpenSim's shipped result", shipped)):
        print(f"ours minus {title}, deg: mean, rms without the mean; range of theirs; our stated sigma")
        for name, (mean, rms, span, sigma) in differences_deg(angles, mot).items():
            print(f"  {name:14} {mean:7.2f} {rms:6.2f} {span:7.1f} {sigma:6.2f}")


if __name__ == "__main__":
    main()
