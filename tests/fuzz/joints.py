"""Readers of joints, joint angles, subjects and models of skeletons, and what independent readers say is in them."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from fuzz.reader import Reader
from fuzz.tables import _blanks, _rows, whole
from scipy.spatial.transform import Rotation

from mosca.data.joint_angles import JointAngles
from mosca.data.joint_motion import JointMotion
from mosca.formats.bodies.subject_file import read_subject, write_subject
from mosca.formats.joints.angles_csv import read_angles_csv, write_angles_csv
from mosca.formats.joints.joints_csv import read_joints_csv, write_joints_csv
from mosca.skeleton.fit import FittedSubject
from mosca.skeleton.joints import SegmentAxes
from mosca.skeleton.mjcf import compiled
from mosca.skeleton.model import model_from_mjcf, read_skeleton_model

JOINTS = ("pelvis", "l_hip", "r_hip")


def _fields(value: JointMotion | JointAngles) -> Any:
    return {name: getattr(value, name) for name in value.__dataclass_fields__}


def _joints_seed(folder: Path) -> None:
    rng = np.random.default_rng(9)
    n, j = 4, len(JOINTS)
    half = rng.normal(0, 1e-2, (2, n, j, 3, 3))
    place, turn = (half + half.swapaxes(3, 4)) / 2
    rotation = Rotation.random(n * j, random_state=2).as_quat().reshape(n, j, 4)
    rotation[1, 1] = np.nan
    frame = np.arange(4, 4 + n)
    write_joints_csv(
        JointMotion(frame, 10_000_000 * frame, JOINTS, rng.normal(size=(n, j, 3)), place, rotation, turn),
        folder / "joints.csv",
    )


def _joints_expected(folder: Path) -> Any:
    header, *rows = _rows(folder / "joints.csv")
    column = {name: [row[k] for row in rows] for k, name in enumerate(header)}
    frame, time_ns, joint = whole(column["frame"]), whole(column["time_ns"]), column["joint"]
    frames = sorted(set(frame.tolist()))
    names = tuple(name for name, k in zip(joint, frame, strict=True) if k == frames[0])
    n, j = len(frames), len(names)
    if joint != list(names) * n or len(set(names)) < j or (frame != np.repeat(frames, j)).any():
        raise ValueError("order")
    if (time_ns != np.repeat(time_ns[::j], j)).any():
        raise ValueError("times")
    number = {name: _blanks(column[name]) for name in header[3:]}
    if any(np.isinf(values).any() for values in number.values()):
        raise ValueError("infinite")
    turn = np.stack([number[f"q{a}"] for a in "wxyz"], axis=1)
    known = ~np.isnan(turn).all(axis=1)
    if not (abs(np.sqrt((turn[known] ** 2).sum(axis=1)) - 1) <= 1e-6).all():
        raise ValueError("norm")

    def covariance(pattern: str) -> np.ndarray:
        return np.array(
            [[number[pattern.format(min(a + b, b + a))] for b in "xyz"] for a in "xyz"]
        ).transpose(2, 0, 1).reshape(n, j, 3, 3)  # fmt: skip

    return {
        "frame": frames,
        "time_ns": time_ns[::j],
        "joints": names,
        "centre": np.stack([number[f"{a}_m"] for a in "xyz"], axis=1).reshape(n, j, 3),
        "centre_covariance": covariance("s{}_m2"),
        "rotation": turn.reshape(n, j, 4),
        "rotation_covariance": covariance("r{}_rad2"),
    }


def _angles_seed(folder: Path) -> None:
    rng = np.random.default_rng(10)
    angles = rng.normal(size=(5, 2))
    angles[2, 1] = np.nan
    frame = np.arange(5)
    write_angles_csv(
        JointAngles(frame, 10_000_000 * frame, ("l_hip_flexion", "r_hip_flexion"), angles, 0.01 * abs(angles)),
        folder / "angles.csv",
    )


def _angles_expected(folder: Path) -> Any:
    header, *rows = _rows(folder / "angles.csv")
    names = [name.removesuffix("_deg") for name in header[2::2]]
    wanted = ["frame", "time_ns"] + [one for name in names for one in (f"{name}_deg", f"{name}_sigma_deg")]
    if header != wanted or len(set(names)) < len(names):
        raise ValueError(header)
    column = {name: [row[k] for row in rows] for k, name in enumerate(header)}
    tables = [
        np.array([_blanks(column[name + end]) for name in names]).T * (np.pi / 180) for end in ("_deg", "_sigma_deg")
    ]
    if np.isinf(tables).any():
        raise ValueError("infinite")
    return {
        "frame": whole(column["frame"]),
        "time_ns": whole(column["time_ns"]),
        "names": tuple(names),
        "angles": tables[0],
        "sigma": tables[1],
    }


LEGS = """<mujoco><size nuser_site="3"/>
<custom><numeric name="rotation_sigma_deg/r_knee" data="5 10 60"/>
<tuple name="midpoint/r_knee"><element objtype="site" objname="RKNE"/><element objtype="site" objname="RKNM"/></tuple>
</custom><worldbody><body name="r_thigh"><joint name="r_hip" type="free"/>
<geom size="0.1"/><site name="RTHI" pos="0 -0.21 0.08" user="0.02 0.06 0.02"/>
<site name="RTHF" pos="0.085 -0.16 0.004"/><site name="RKNE" pos="0 -0.425 0.055"/>
<site name="RKNM" pos="0 -0.4 -0.055"/>
<body name="r_shank" pos="0 -0.429 0"><joint name="r_knee" type="ball"/><geom size="0.1"/>
<site name="RTIB" pos="0 -0.201 0.055"/><site name="RANK" pos="-0.01 -0.426 0.04" user="0.015 0.015 0.015"/>
</body></body></worldbody></mujoco>
"""
MARKERS = ("RTHI", "RTHF", "RKNE", "RKNM", "RTIB", "RANK")


def _subject_seed(folder: Path) -> None:
    rng = np.random.default_rng(11)
    model = model_from_mjcf(LEGS, compiled(LEGS, "legs"), MARKERS, "legs")
    p = len(model.parameters)
    root, axes = rng.normal(0, 1e-3, (p, p)), {"r_thigh": np.eye(3)}
    subject = FittedSubject(
        model=model,
        parameters=model.parameters + rng.normal(0, 0.01, p),
        covariance=root @ root.T,
        skin_m=np.abs(rng.normal(0, 0.01, len(MARKERS))),
        size=1.1,
        q=np.r_[rng.normal(size=3), 1.0, 0, 0, 0, 0, 1.0, 0, 0],
        posture=rng.normal(0, 0.1, 9),
        axes=SegmentAxes(axes, {"r_thigh": rng.normal(size=(3, p))}),
        residual_rms_m=0.004,
        frames=60,
    )
    write_subject(subject, folder / "subject.npz")


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return dict(value) if isinstance(value, Mapping) else value


def _model(folder: Path) -> Any:
    model = read_skeleton_model(folder / "legs.xml", MARKERS)
    return {"labels": model.labels, "joints": model.joints, "parameters": model.parameters}


def _model_expected(folder: Path) -> Any:
    """What MuJoCo's editable form of a model, which our reader does not use, says of places."""
    spec = mujoco.MjSpec.from_string((folder / "legs.xml").read_text())
    sites = [site for site in spec.sites if site.name in MARKERS]
    places = [body.pos for body in spec.bodies[2:]] + [site.pos for site in sites]
    return {
        "labels": tuple(site.name for site in sites),
        "joints": tuple(joint.name for joint in spec.joints[1:]),
        "parameters": np.concatenate(places),
    }


READERS = (
    Reader(
        "skeleton subject",
        (_subject_seed,),
        ("subject.npz",),
        lambda folder: _plain(read_subject(folder / "subject.npz")),
    ),
    Reader(
        "skeleton model",
        (lambda folder: (folder / "legs.xml").write_text(LEGS) and None,),
        ("legs.xml",),
        _model,
        _model_expected,
    ),
    Reader(
        "joints.csv",
        (_joints_seed,),
        ("joints.csv",),
        lambda folder: _fields(read_joints_csv(folder / "joints.csv")),
        _joints_expected,
    ),
    Reader(
        "angles.csv",
        (_angles_seed,),
        ("angles.csv",),
        lambda folder: _fields(read_angles_csv(folder / "angles.csv")),
        _angles_expected,
    ),
)
