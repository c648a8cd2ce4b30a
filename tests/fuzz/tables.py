"""Readers of tracks, references, motions and records, and what independent readers say is in those files."""

import csv
import json
import struct
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
from fuzz.reader import DATA, Reader, copied
from fuzz.toml_files import plain, toml_seed
from scipy.spatial.transform import Rotation

from mosca.data.bodies import BodyPoses
from mosca.data.files.target_tables import WandPointsTable
from mosca.data.motion.asf import read_asf_amc
from mosca.data.motion.bvh import read_bvh
from mosca.data.motion.joint_csv import read_points_csv
from mosca.data.motion.motion import Motion, matrices_from_quaternions
from mosca.data.tracks import Tracks, write_npz
from mosca.data.truth import TABLES, JointTruth, Truth, read_truth, write_truth
from mosca.data.wands import SingleLight
from mosca.editing.edit_file import read_track_edits
from mosca.editing.history import TakeFormat, read_edited, write_edited
from mosca.formats.bodies.bodies_csv import read_bodies_csv, write_bodies_csv
from mosca.formats.rigs.calibration_record import read_calibration_record
from mosca.formats.selfcal_points import read_selfcal_points
from mosca.formats.tracks.c3d import read_c3d
from mosca.formats.tracks.marker_table import MarkerTable
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks
from mosca.formats.tracks.trc import read_trc
from mosca.formats.wand_points import read_wand_points
from mosca.machines.identification.commands import read_commands
from reports.record import read_record
from reports.suite.history import PastResult, append_history, read_history
from scenarios.score.reference import read_reference_csv

ROOT = Path(__file__).resolve().parents[2]
UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""World (Z up) from a file with Y up."""


def some_tracks() -> Tracks:
    """Return 10 frames of 3 markers."""
    rng = np.random.default_rng(5)
    frame, track = np.repeat(np.arange(3, 13), 3), np.tile([0, 1, 2], 10)
    n = len(frame)
    half = rng.normal(size=(n, 3, 3)) * 1e-4
    return Tracks(
        frame, frame * 10_000_000, track, np.array(["LFHD", "RFHD", ""])[track], rng.normal(size=(n, 3)),
        half @ half.transpose(0, 2, 1), rng.integers(2, 5, n), rng.uniform(0.01, 0.3, n),
        np.where(rng.random(n) < 0.2, "filled", "measured"),
    )  # fmt: skip


def _tracks(name: str) -> Any:
    def read(folder: Path) -> Any:
        tracks = read_tracks(folder / name)
        return {key: getattr(tracks, key) for key in Tracks.__dataclass_fields__}

    return read


def _rows(path: Path, encoding: str = "utf-8") -> list[list[str]]:
    with open(path, encoding=encoding, newline="") as file:
        return list(csv.reader(file, strict=True))


def whole(cells: Any) -> np.ndarray:
    """Return whole numbers of 64 bit; no underscores, no digits of other scripts."""
    plain(cells)
    return np.array([int(one) for one in cells], dtype=np.int64)


def _blanks(cells: Any) -> np.ndarray:
    return plain([one if one else "nan" for one in cells])


def _tracks_csv_expected(folder: Path) -> Any:
    header, *rows = _rows(folder / "tracks.csv")
    column = {name: [row[k] for row in rows] for k, name in enumerate(header)}
    upper = {name: _blanks(column[f"s{name}"]) for name in ("xx", "yy", "zz", "xy", "xz", "yz")}
    covariance = np.array([[upper[min(a + b, b + a)] for b in "xyz"] for a in "xyz"])
    return {
        **{name: whole(column[name]) for name in ("frame", "time_ns", "track", "n_cameras")},
        "label": column["label"],
        "xyz": np.stack([_blanks(column[a]) for a in "xyz"], axis=1),
        "covariance": covariance.transpose(2, 0, 1),
        "residual_px": _blanks(column["residual_px"]),
        "status": column["status"],
    }


def _bodies_seed(folder: Path) -> None:
    rng = np.random.default_rng(9)
    n = 12
    half = rng.normal(size=(n, 6, 6)) * 1e-4
    columns = [rng.normal(size=(n, 4)), rng.normal(size=(n, 3)), half @ half.transpose(0, 2, 1)]
    withheld = np.arange(n) % 4 == 3
    for column in columns:
        column[withheld] = np.nan
    poses = BodyPoses(
        np.arange(n) // 2, np.arange(n) // 2 * 10_000_000, np.array(["cup", "drone"])[np.arange(n) % 2], *columns,
        rng.integers(3, 6, n), rng.random(n) * 1e-3, np.where(withheld, "withheld", "measured"),
    )  # fmt: skip
    write_bodies_csv(poses, folder / "bodies.csv")


def _bodies(folder: Path) -> Any:
    poses = read_bodies_csv(folder / "bodies.csv")
    return {key: getattr(poses, key) for key in BodyPoses.__dataclass_fields__}


def _bodies_expected(folder: Path) -> Any:
    header, *rows = _rows(folder / "bodies.csv")
    column = {name: [row[k] for row in rows] for k, name in enumerate(header)}
    axes = "xyzuvw"
    pairs = [[axes[min(i, j)] + axes[max(i, j)] for j in range(6)] for i in range(6)]
    covariance = np.array([[_blanks(column[f"c{pair}"]) for pair in row] for row in pairs])
    return {
        **{name: whole(column[name]) for name in ("frame", "time_ns", "n_markers")},
        "body": column["body"],
        "status": column["status"],
        "quaternion": np.stack([_blanks(column[f"q{a}"]) for a in "wxyz"], axis=1),
        "position": np.stack([_blanks(column[a]) for a in "xyz"], axis=1),
        "covariance": covariance.transpose(2, 0, 1),
        "residual_m": _blanks(column["residual_m"]),
    }


def _truth_seed(folder: Path) -> None:
    rng = np.random.default_rng(7)
    t, m, c = 8, 3, 2
    write_truth(
        Truth(
            np.arange(t) * 10_000_000, ("a", "b", "c"), rng.normal(size=(t, m, 3)), rng.random((t, m, c)),
            ("left", "right"), rng.normal(size=(t, m, c, 2)), rng.random((t, m, c)),
            rng.integers(0, 10**9, (t, c)), rng.normal(size=(t, c, 3, 3)), rng.normal(size=(t, c, 3)),
            joints=JointTruth(("pelvis", "neck"), rng.normal(size=(t, 2, 3)), rng.normal(size=(t, 2, 4))),
        ),
        folder / "truth.npz",
    )  # fmt: skip


def _truth(folder: Path) -> Any:
    truth = read_truth(folder / "truth.npz")
    joints = {} if truth.joints is None else {"joints": vars(truth.joints)}
    return joints | {key: getattr(truth, key) for key in Truth.__dataclass_fields__ if key not in TABLES}


def _table(table: MarkerTable) -> Any:
    return {"names": list(table.names), "xyz": table.xyz, "first": table.first_frame, "rate": table.rate_hz}


def _c3d_with_angles(folder: Path) -> None:
    path = str(folder / "a.c3d")
    write_tracks(some_tracks(), folder / "a.c3d", 100.0)
    document = ezc3d.c3d(path)
    document.add_parameter("POINT", "ANGLES", ["LFHD"])
    document.write(path)


def _c3d_expected(folder: Path) -> Any:
    path = folder / "a.c3d"
    document = ezc3d.c3d(str(path))
    point = document["parameters"]["POINT"]
    units = point["UNITS"]["value"]
    unit = {"mm": 1e-3, "cm": 1e-2, "dm": 0.1, "m": 1.0, "in": 0.0254}[units[0].strip().lower() if units else "mm"]
    points = document["data"]["points"]
    # the header is read anew: ezc3d corrects it without a word
    first, last, block = struct.unpack("<6x2H6xH", path.read_bytes()[:18])
    if points.shape[2] != last - first + 1 or (block - 1) * 512 > path.stat().st_size:
        raise ValueError(f"frames {first} to {last} in block {block}, {points.shape[2]} frames of points")
    xyz = points[:3].transpose(2, 1, 0) * unit
    xyz[document["data"]["meta_points"]["residuals"][0].T < 0] = np.nan
    labels = [label.strip() for key in ("LABELS", "LABELS2") for label in point.get(key, {}).get("value", [])]
    names: list[str] = []
    for k in range(points.shape[1]):
        label = labels[k] if k < len(labels) and labels[k] else f"point_{k + 1}"
        names.append(label if label not in names else f"{label}_{k + 1}")
    kinds = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
    others = [str(label).strip() for kind in kinds for label in point.get(kind, {}).get("value", [])]
    places = [k for k, name in enumerate(names) if name not in others]
    if not places:
        raise ValueError("no place")
    names, xyz = [names[k] for k in places], xyz[:, places]
    return {"names": names, "xyz": xyz, "first": first - 1, "rate": point["RATE"]["value"][0]}


def _text(path: Path, encoding: str = "latin-1") -> str:
    """Return a text, its line ends as any system writes them."""
    return path.read_bytes().decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def _trc_expected(folder: Path) -> Any:
    lines = _text(folder / "a.trc", "utf-8-sig").split("\n")
    head = dict(zip(lines[1].split("\t"), (cell.strip() for cell in lines[2].split("\t")), strict=False))
    names = [cell.strip(" ") for cell in lines[3].split("\t")[2:] if cell.strip(" ")]
    rows = [[c.strip() for c in line.split("\t")] for line in lines[5:] if line.strip()]
    if int(head["NumFrames"]) != len(rows) or int(head["NumMarkers"]) != len(names):
        raise ValueError(f"{head['NumFrames']} frames are announced, {len(rows)} are there")
    width = 3 * len(names)
    cells = [(row[2:] + [""] * width)[:width] for row in rows]
    xyz = np.array([_blanks(["nan" if c.lower() == "nan" else c for c in row]) for row in cells])
    unit = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}[head["Units"].lower()]
    rate = plain([head["DataRate"]])[0]
    return {
        "names": names,
        "xyz": xyz.reshape(len(rows), -1, 3) * unit,
        "first": plain([rows[0][0]])[0],
        "rate": rate,
    }


TRUTH_CSV = "label,time_ns,x,y,z,sigma_m\n" + "".join(
    f"{name},{k * 10_000_000},{0.1 * k!r},{float(np.sin(k + row))!r},1.5,0.0002\n"
    for k in range(8)
    for row, name in enumerate("ab")
)
WIDE_CSV = "time,a.x,a.y,a.z,b.x,b.y,b.z\n" + "".join(
    f"{0.01 * k!r},{0.1 * k!r},2.5,3,{1 / (k + 1)!r},,\n" if k == 3 else f"{0.01 * k!r},{0.1 * k!r},2.5,3,1.25,-1,0\n"
    for k in range(8)
)


def _reference(folder: Path) -> Any:
    found = read_reference_csv(folder / "truth.csv")
    both = {name: (t, xyz) for name, t, xyz in zip(found.names, found.time_ns, found.xyz, strict=True)}
    return {"markers": both, "sigma": found.sigma_m}


def _reference_expected(folder: Path) -> Any:
    header, *rows = _rows(folder / "truth.csv")
    column = {name: [row[k] for row in rows] for k, name in enumerate(header)}
    xyz = np.stack([_blanks(column[a]) for a in "xyz"], axis=1)
    time_ns = whole(column["time_ns"]) if "time_ns" in column else np.zeros(len(rows), np.int64)
    sigma = plain(column["sigma_m"]) if "sigma_m" in column else np.zeros(1)
    known = np.isfinite(xyz).all(axis=1)
    markers = {}
    for name in dict.fromkeys(label for label, one in zip(column["label"], known, strict=True) if one):
        of = np.flatnonzero(known & (np.array(column["label"]) == name))
        of = of[np.argsort(time_ns[of], kind="stable")]
        markers[name] = (time_ns[of], xyz[of])
    with np.errstate(over="ignore"):
        return {"markers": markers, "sigma": float(np.sqrt(np.mean(sigma**2)))}


def _wide(folder: Path) -> Any:
    motion = read_points_csv(folder / "a.csv")
    return {"names": motion.names, "time": motion.time_s, "xyz": motion.xyz}


def _wide_expected(folder: Path) -> Any:
    rows = [row for row in _rows(folder / "a.csv", "latin-1") if row]
    header = [cell.strip() for cell in rows[0]]
    table = np.array([_blanks(["nan" if c.strip().lower() == "nan" else c.strip() for c in row]) for row in rows[1:]])
    names = tuple(name[:-2] for name in header[1::3])
    return {"names": names, "time": table[:, 0], "xyz": table[:, 1:].reshape(len(table), len(names), 3)}


WAND_LAYOUT = WandPointsTable(y_axis="up", pixel_origin="corner", size_px=(640, 480))
WAND_CSV = "pt1_cam1_X,pt1_cam1_Y,pt1_cam2_X,pt1_cam2_Y,pt2_cam1_X,pt2_cam1_Y,pt2_cam2_X,pt2_cam2_Y\n" + "".join(
    f"{100 + 3.25 * k!r},50.5,,,{200 + k},{1e2!r},NaN,NaN\n" if k == 3 else f"{10 * k}.5,50,60,70,1e2,200.125,3,4.5\n"
    for k in range(8)
)


def _wand_points(folder: Path) -> Any:
    seen = read_wand_points(folder / "a.csv", WAND_LAYOUT, 2)
    key = np.lexsort((seen.camera, seen.mark, seen.frame))
    return {
        "cameras": list(seen.cameras),
        "frames": seen.frames,
        "of": np.stack([seen.frame, seen.mark, seen.camera], axis=1)[key],
        "xy": seen.xy_px[key],
    }


def _wand_points_expected(folder: Path) -> Any:
    rows = _rows(folder / "a.csv")
    if rows and any("cam" in cell.lower() for cell in rows[0]):
        names = [cell.strip(" \t").lower() for cell in rows[0]]
        count = len(names) // 4
        points = [names[0].rsplit("_cam", 1)[0], names[2 * count].rsplit("_cam", 1)[0]]
        made = [(p, c, a) for p in points for c in range(1, count + 1) for a in "xy"]
        if any(
            name.replace("_cam_", "_cam") not in (f"{p}_cam{c:0{d}}_{a}" for d in range(1, 5))
            for name, (p, c, a) in zip(names, made, strict=True)
        ):
            raise ValueError(f"{names} given")
        rows = rows[1:]
    table = np.array([_blanks(["nan" if not c.strip(" \t") else c for c in row]) for row in rows])
    xy = table.reshape(len(table), 2, -1, 2) - 0.5
    xy[..., 1] = 479 - xy[..., 1]
    of = np.argwhere(~np.isnan(xy).any(axis=3))
    seen = xy[tuple(of.T)]
    if (np.isnan(xy[..., 0]) != np.isnan(xy[..., 1])).any() or not (abs(2 * seen - [639, 479]) <= [640, 480]).all():
        raise ValueError("outside, or half a point")
    return {"cameras": [f"cam{k + 1}" for k in range(xy.shape[2])], "frames": len(xy), "of": of, "xy": seen}


LIGHT = {
    "points.dat": "1.5 2 NaN 4\n3 4 NaN 1e2\n1 1 NaN 1\n5 6 7 0\n8 9 10.25 0\n1 1 1 1\n",
    "IdMat.dat": "1 1 0 1\n1 0 1 0\n",
    "Res.dat": "640 480\n320 240\n",
    "camera_order.txt": "left\nright\n",
}


def _light_seed(folder: Path) -> None:
    for name, text in LIGHT.items():
        (folder / name).write_text(text)


def _light(folder: Path) -> Any:
    seen = read_selfcal_points(folder, SingleLight())
    key = np.lexsort((seen.camera, seen.frame))
    return {
        "cameras": list(seen.cameras),
        "sizes": seen.sizes,
        "frames": seen.frames,
        "of": np.stack([seen.frame, seen.camera], axis=1)[key],
        "xy": seen.xy_px[key],
    }


def _light_expected(folder: Path) -> Any:
    def rows(name: str) -> np.ndarray:
        lines = (folder / name).read_text("utf-8-sig").split("\n")
        return np.array([plain(line.split()) for line in lines if line.strip()])

    sizes = plain((folder / "Res.dat").read_text("utf-8-sig").split()).reshape(-1, 2)
    names = (folder / "camera_order.txt").read_text("utf-8-sig").split()
    xy = rows("points.dat").reshape(len(sizes), 3, -1)[:, :2]
    seen = rows("IdMat.dat")
    if seen.shape != xy[:, 0].shape or not np.isin(seen, (0, 1)).all():
        raise ValueError("IdMat.dat")
    of = np.argwhere(seen.T == 1)
    places = xy[of[:, 1], :, of[:, 0]]
    if not (abs(2 * places - sizes[of[:, 1]] + 1) <= sizes[of[:, 1]]).all():
        raise ValueError("outside")
    return {
        "cameras": names if len(names) == len(sizes) else [f"cam_{k + 1}" for k in range(len(sizes))],
        "sizes": sizes,
        "frames": xy.shape[2],
        "of": of,
        "xy": places,
    }


BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0.0 0.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Chest
  {
    OFFSET 0.0 12.5 0.5
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0.0 20.0 1.0
    }
  }
  JOINT Leg
  {
    OFFSET 8.0 -3.0 0.0
    CHANNELS 3 Yrotation Xrotation Zrotation
    End Site
    {
      OFFSET 0.0 -40.0 0.0
    }
  }
}
MOTION
Frames: 4
Frame Time: 0.01
0.1 90.0 3.0 1.0 2.0 3.0 4.0 5.0 6.0 7.0 8.0 9.0
0.2 90.1 3.1 1.5 2.5 3.5 4.5 5.5 6.5 7.5 8.5 9.5
0.3 90.2 3.2 -1.0 -2.0 30.0 40.0 50.0 60.0 70.0 80.0 90.0
0.4 90.3 3.3 10.0 20.0 30.0 40.0 50.0 60.0 70.0 80.0 100.0
"""


def _motion(motion: Motion) -> Any:
    return {
        "names": motion.skeleton.names,
        "parents": motion.skeleton.parents,
        "offsets": motion.skeleton.offsets,
        "rate": motion.frame_rate_hz,
        "root": motion.root_xyz,
        "rotations": matrices_from_quaternions(motion.rotations),
    }


def _bvh_expected(folder: Path) -> Any:
    head, motion = _text(folder / "a.bvh").split("MOTION", 1)
    names, parents, offsets, channels, stack = [], [], [], [], []
    for words in filter(None, map(str.split, head.split("\n"))):
        if words[0] in ("ROOT", "JOINT", "End"):
            parents.append(stack[-1] if stack else -1)
            given = [word for word in words[1:] if word != "{"]
            names.append(names[stack[-1]] + "_end" if words[0] == "End" else "_".join(given))
            offsets.append(np.zeros(3))
            channels.append([])
        if words[-1] == "{":
            stack.append(len(names) - 1)
        elif words[0] == "}":
            stack.pop()
        elif words[0] == "OFFSET":
            offsets[stack[-1]] = plain(words[1:])
        elif words[0] == "CHANNELS":
            channels[stack[-1]] = words[2:]
    words = motion.split()
    table = plain(words[5:]).reshape(int(plain([words[1]])[0]), -1)
    rotations, column, root = [], 0, None
    for k, own in enumerate(channels):
        cells = table[:, column : column + len(own)]
        column += len(own)
        turns = [c for c, name in enumerate(own) if name.endswith("rotation")]
        order = "".join(own[c][0] for c in turns)
        turn = Rotation.identity(len(table))
        for c, axis in zip(turns, order, strict=True):
            turn = turn * Rotation.from_euler(axis, cells[:, c : c + 1], degrees=True)
        rotations.append(UP @ turn.as_matrix() @ UP.T)
        place = np.tile(offsets[k], (len(table), 1))
        for c, name in enumerate(own):
            if name.endswith("position"):
                place[:, "XYZ".index(name[0])] = cells[:, c]
        if k == 0:
            root = place
        else:
            offsets[k] = place[0]
    offsets[0] = np.zeros(3)
    return {
        "names": tuple(names),
        "parents": parents,
        "offsets": np.array(offsets) @ UP.T * 0.01,
        "rate": 1 / plain([words[4]])[0],
        "root": root @ UP.T * 0.01,
        "rotations": np.stack(rotations, axis=1),
    }


ASF = """:version 1.10
:name subject
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name thigh
    direction 0.0 -1.0 0.0
    length 7.5
    axis 10.0 0.0 20.0 XYZ
    dof rx ry rz
  end
  begin
    id 2
    name shin
    direction 0.0 -1.0 0.0
    length 7.0
    axis 0.0 5.0 0.0 XYZ
    dof rx
  end
:hierarchy
  begin
    root thigh
    thigh shin
  end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n" + "".join(
    f"{k}\nroot {0.1 * k:.3f} 17.0 -3.0 1.0 {2.0 * k} 3.0\nthigh 1.5 -2.5 {k}.0\nshin {10 * k}.25\n"
    for k in range(1, 6)
)


def _asf_seed(folder: Path) -> None:
    (folder / "a.asf").write_text(ASF)
    (folder / "a.amc").write_text(AMC)


def _amc(folder: Path) -> Any:
    motion = read_asf_amc(folder / "a.asf", folder / "a.amc")
    return {"names": motion.skeleton.names, "root": motion.root_xyz, "frames": len(motion.rotations)}


def _amc_expected(folder: Path) -> Any:
    """Names, the root's path and the count of frames: an own reading of sections, bones and columns."""
    section, bones, length, order, position = "", ["root"], 1.0, [], np.zeros(3)
    children: dict[str, list[str]] = {}
    for words in filter(None, map(str.split, _text(folder / "a.asf").split("\n"))):
        if words[0].startswith(":"):
            section = words[0][1:]
        elif section == "units" and words[0] == "length" and len(words) == 2:
            length = plain(words[1:])[0]
        elif section == "root" and words[0] == "order":
            order = [word.lower() for word in words[1:]]
        elif section == "root" and words[0] == "position":
            position = plain(words[1:])
        elif section == "bonedata" and words[0] == "name" and len(words) > 1 and words[1] not in bones:
            bones.append(words[1])
        elif section == "hierarchy" and words[0] not in ("begin", "end") and not words[0].startswith("#"):
            children.setdefault(words[0], []).extend(words[1:])
    names = ["root"]
    for name in names:
        names += [one for one in bones if one in children.get(name, ())]
    leaves = [f"{name}_end" for name in names[1:] if not children.get(name)]
    rows = [line.split() for line in _text(folder / "a.amc").split("\n")]
    frames = [row for row in rows if len(row) == 1 and row[0].isdecimal()]
    cells = np.array([plain(row[1:]) for row in rows if row and row[0] == "root"])
    for row in rows:
        if len(row) > 1 and row[0][0] not in ":#":
            plain(row[1:])
    root = np.tile(position, (len(cells), 1))
    for k, channel in enumerate(("tx", "ty", "tz")):
        if channel in order:
            root[:, k] += cells[:, order.index(channel)]
    return {"names": tuple(names + leaves), "root": root @ UP.T * 0.0254 / length, "frames": len(frames)}


def _record(folder: Path) -> Any:
    record = read_record(folder / "a.json")
    return {
        "scenario": record.scenario,
        "seed": record.seed,
        "passed": record.passed,
        "metrics": [(m.name, m.value, m.unit, m.n, m.limit, m.passed) for m in record.metrics],
    }


def _record_expected(folder: Path) -> Any:
    def refuse(text: str) -> None:
        raise ValueError(text)

    given = json.loads((folder / "a.json").read_bytes().decode("utf-8"), parse_constant=refuse)
    keys = ("name", "value", "unit", "n", "limit", "passed")
    metrics = [tuple(one.get(key) for key in keys) for one in given["metrics"]]
    return {**{key: given[key] for key in ("scenario", "seed", "passed")}, "metrics": metrics}


CALIBRATION_RECORD = """{"target": "TestField", "image_points": 1200, "left_out": 3, "sigma0": 1.04,
 "scaled_by": "the test field's marks", "shake_px": 0.03, "weak": ["cam1.a"],
 "cameras": [{"name": "cam1", "sigma_px": [0.04, 0.05], "sigma_m": [2e-5, null]}],
 "findings": [{"code": "little-depth", "severity": "warn", "message": "a plane", "camera": "cam1"}]}
"""


def _calibration_record(folder: Path) -> Any:
    return read_calibration_record(folder / "a.json").model_dump(mode="json")


def _calibration_record_expected(folder: Path) -> Any:
    document = json.loads((folder / "a.json").read_bytes().decode("utf-8"))
    optional = [{"camera": None, **one} for one in document["findings"]]
    return {**document, "findings": optional}


def _history(folder: Path) -> Any:
    return [vars(one) for one in read_history(folder / "history.jsonl")]


def _history_expected(folder: Path) -> Any:
    lines = (folder / "history.jsonl").read_text(encoding="utf-8").splitlines()
    keys = ("time", "commit", "scenario", "content", "as_it_must", "seconds", "values")
    return [{key: one[key] for key in keys} for one in (json.loads(line) for line in lines if line.strip())]


def _history_seed(folder: Path) -> None:
    values = {"position_rms": 1.25e-4, "completeness": 0.995}
    append_history(
        folder / "history.jsonl",
        [PastResult(f"2026-01-0{k}T10:00:00Z", f"abc{k}", "a/b", "0123", k > 1, 2.5 * k, values) for k in (1, 2)],
    )


def _record_seed(folder: Path) -> None:
    source = sorted((ROOT / "reports/baselines").glob("**/*.json"))[0]
    (folder / "a.json").write_bytes(source.read_bytes())


EDITS = TakeFormat(read_tracks, lambda tracks, path: write_tracks(tracks, path, 100.0), read_track_edits)


def _edited_seed(folder: Path) -> None:
    frame = np.repeat(np.arange(20), 2)
    tracks = Tracks(
        frame, frame * 10_000_000, np.tile([0, 1], 20), np.tile(["A", "B"], 20),
        np.random.default_rng(0).normal(size=(40, 3)),
        np.tile(np.eye(3), (40, 1, 1)), np.full(40, 3), np.zeros(40), np.full(40, "measured"),
    )  # fmt: skip
    (folder / "e.toml").write_text("[[edit]]\ntrim = { frames = [2, 17] }\n[[edit]]\nfilter = { cutoff_hz = 20 }\n")
    write_tracks(tracks, folder / "start.csv", 100.0)
    edited = read_edited(folder / "start.csv", EDITS).edited(read_track_edits(folder / "e.toml"))
    write_edited(edited, folder / "out.csv", EDITS)


def _edited(folder: Path) -> Any:
    take = read_edited(folder / "out.csv", EDITS).undone(2).take
    return {name: getattr(take, name) for name in Tracks.__dataclass_fields__}


COMMANDS_CSV = """time_s,left,right,note
0.0,12.5,-3,a
0.2,-7.25,4e1,b
0.4,0,0,
"""


def _commands(folder: Path) -> Any:
    rows = read_commands(folder / "a.csv")
    return {"clock": rows.clock, "at": rows.at, "names": rows.names, "values": rows.values}


def _commands_expected(folder: Path) -> Any:
    header, *rows = _rows(folder / "a.csv")
    (clock,) = [name for name in ("time_ns", "time_s", "frame") if name in header]
    names = ("left", "right") if {"left", "right"} <= set(header) else ("pwm_left", "pwm_right")
    if any(header.count(name) != 1 for name in (clock, *names)) or any(len(row) != len(header) for row in rows):
        raise ValueError(header)
    column = {name: [row[header.index(name)] for row in rows] for name in (clock, *names)}
    at = plain(column[clock]) if clock == "time_s" else whole(column[clock])
    values = np.array([plain(column[name]) for name in names]).T
    if not len(at) or not np.isfinite(at).all() or not np.isfinite(values).all() or (np.diff(at) <= 0).any():
        raise ValueError("values")
    return {"clock": clock, "at": at, "names": names, "values": values}


READERS = (
    Reader(
        "tracks.csv",
        (lambda folder: write_tracks(some_tracks(), folder / "tracks.csv", 100.0),),
        ("tracks.csv",),
        _tracks("tracks.csv"),
        _tracks_csv_expected,
    ),
    Reader("bodies.csv", (_bodies_seed,), ("bodies.csv",), _bodies, _bodies_expected),
    Reader(
        "tracks.parquet",
        (lambda folder: write_tracks(some_tracks(), folder / "tracks.parquet", 100.0),),
        ("tracks.parquet",),
        _tracks("tracks.parquet"),
    ),
    Reader(
        "tracks.npz",
        (lambda folder: write_npz(some_tracks(), folder / "tracks.npz"),),
        ("tracks.npz",),
        _tracks("tracks.npz"),
    ),
    Reader("edit record", (_edited_seed,), ("out.csv.edits.npz",), _edited),
    Reader("truth.npz", (_truth_seed,), ("truth.npz",), _truth),
    Reader(
        "c3d",
        (
            lambda folder: write_tracks(some_tracks(), folder / "a.c3d", 100.0),
            _c3d_with_angles,
            *copied(DATA / "c3d_trc/kineticstoolkit/sample_static.c3d", "a.c3d"),
        ),
        ("a.c3d",),
        lambda folder: _table(read_c3d(folder / "a.c3d")),
        _c3d_expected,
    ),
    Reader(
        "trc",
        (
            lambda folder: write_tracks(some_tracks(), folder / "a.trc", 100.0),
            *copied(DATA / "c3d_trc/opensim/dataWithNaNsOfDifferentCases.trc", "a.trc"),
        ),
        ("a.trc",),
        lambda folder: _table(read_trc(folder / "a.trc")),
        _trc_expected,
    ),
    Reader("truth.csv", (toml_seed(TRUTH_CSV, "truth.csv"),), ("truth.csv",), _reference, _reference_expected),
    Reader("commands csv", (toml_seed(COMMANDS_CSV, "a.csv"),), ("a.csv",), _commands, _commands_expected),
    Reader("points csv", (toml_seed(WIDE_CSV, "a.csv"),), ("a.csv",), _wide, _wide_expected),
    Reader("multicamselfcal points", (_light_seed,), ("*",), _light, _light_expected),
    Reader("wand points", (toml_seed(WAND_CSV, "a.csv"),), ("a.csv",), _wand_points, _wand_points_expected),
    Reader(
        "bvh",
        (toml_seed(BVH, "a.bvh"),),
        ("a.bvh",),
        lambda folder: _motion(read_bvh(folder / "a.bvh")),
        _bvh_expected,
    ),
    Reader("asf amc", (_asf_seed,), ("a.asf", "a.amc"), _amc, _amc_expected),
    Reader("history.jsonl", (_history_seed,), ("history.jsonl",), _history, _history_expected),
    Reader(
        "calibration record",
        (toml_seed(CALIBRATION_RECORD, "a.json"),),
        ("a.json",),
        _calibration_record,
        _calibration_record_expected,
    ),
    Reader("record.json", (_record_seed,), ("a.json",), _record, _record_expected),
)
