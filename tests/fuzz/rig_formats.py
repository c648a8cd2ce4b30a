"""Readers of other programs' calibrations, and what independent readers say is in those files."""

import re
import xml.dom.minidom
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from fuzz.reader import DATA, Reader, copied
from fuzz.toml_files import document, plain, values_of
from rigs import ring
from scipy.spatial.transform import Rotation

from mosca.data.rig import FisheyeLens, OpenCVLens
from mosca.formats.rigs.rig_formats import RigFileOptions, read_any_rig, write_any_rig

ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
PINHOLES = (
    OpenCVLens(900.5, 901.25, 320.0, 250.0, k1=-0.1, k2=0.02, p1=1e-3),
    OpenCVLens(800.0, 800.0, 327.5, 245.0),
)
LENSES = (*PINHOLES, FisheyeLens(300.0, 300.5, 327.5, 245.0, 0.01, -0.002, 0.0, 1e-4))
FLIP = np.diag([1.0, -1.0, -1.0])
ASKED = RigFileOptions(size_px=(656, 491), pixel_mm=(0.01, 0.01))


def _seed(name: str, format: str, lenses: tuple[Any, ...]) -> Callable[[Path], None]:
    return lambda folder: write_any_rig(ring(len(lenses), lenses), folder / name, format) and None


def _read(name: str, format: str, options: RigFileOptions | None = None) -> Callable[[Path], Any]:
    return lambda folder: values_of(read_any_rig(folder / name, format, options)[0])


def camera(name: str, size: Any, matrix: Any, d: Any, fisheye: bool, rotation: Any, shift: Any) -> dict[str, Any]:
    """Return the plain values of a camera in OpenCV's words: rotation and shift are camera_from_world."""
    matrix = np.array(matrix, float).reshape(3, 3)
    if not np.allclose([matrix[1, 0], *matrix[2]], [0, 0, 0, 1]) or matrix[0, 1] > 1e-6 * matrix[0, 0]:
        raise ValueError("no camera matrix")
    turn = np.array(rotation, float)
    turn = cv2.Rodrigues(turn.ravel())[0] if turn.size == 3 else turn.reshape(3, 3)
    u, _, vt = np.linalg.svd(turn)
    turn = u @ vt
    keys = ("k1", "k2", "k3", "k4") if fisheye else ORDER
    lens = dict(zip(keys, [*map(float, d), *[0.0] * (len(keys) - len(d))], strict=True))
    fx, fy, cx, cy = (matrix[at] for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    lens |= {"fx_px": fx, "fy_px": fy, "cx_px": cx, "cy_px": cy, "model": "fisheye" if fisheye else "opencv"}
    return {
        "name": name,
        "size": size,
        "lens": lens,
        "rotation": turn.T,
        "position": -turn.T @ np.array(shift, float).ravel(),
    }


def _dialect_expected(folder: Path) -> Any:
    given = document(folder / "a.toml")
    cameras = []
    for key, table in given.get("cameras", given).items():
        if not isinstance(table, dict) or key == "metadata" or table.get("ignore") is True:
            continue
        number = table.get("cam_id", table.get("port"))
        number = int(number) if isinstance(number, float) and number.is_integer() else number
        name = table.get("name") or (f"cam_{number}" if number is not None else key)
        name = re.sub(r"[^A-Za-z0-9_ .-]", "_", name)
        name = name if re.match("[A-Za-z0-9_]", name) else f"cam_{name}"
        fisheye = bool(table.get("fisheye", False))
        parts = (table["matrix"], table["distortions"], fisheye, table["rotation"], table["translation"])
        cameras.append(camera(name, table["size"], *parts))
    return cameras


def _opencv_expected(folder: Path) -> Any:
    path = next(folder.glob("a.*"))
    storage = cv2.FileStorage(path.read_text(encoding="utf-8-sig"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)

    def node(*keys: str) -> Any:
        return next((storage.getNode(key) for key in keys if not storage.getNode(key).empty()), None)

    def matrix(*keys: str) -> Any:
        one = node(*keys)
        if one is None:
            return None
        return one.mat() if one.isMap() else np.array([one.at(k).real() for k in range(one.size())])

    name = node("name")
    d = matrix("distortion_coefficients", "D")
    fisheye = node("fisheye_model", "fisheye")
    turn, shift = matrix("R", "rvec"), matrix("T", "t", "tvec")
    text = name.string() if name is not None and name.isString() else ""
    shown = re.sub(r"[^A-Za-z0-9_ .-]", "_", text or "a")
    return [
        camera(
            shown if re.match("[A-Za-z0-9_]", shown) else f"cam_{shown}",
            [int(node("image_width", "width").real()), int(node("image_height", "height").real())],
            matrix("camera_matrix", "K"),
            [] if d is None else d.ravel().tolist(),
            fisheye is not None and bool(fisheye.real()),
            np.eye(3) if turn is None else turn,
            np.zeros(3) if shift is None else shift,
        )
    ]


def _qtm_expected(folder: Path) -> Any:
    root = xml.dom.minidom.parse(str(folder / "a.qca.txt")).documentElement
    (group,) = [one for one in root.childNodes if one.nodeName == "cameras"][:1]
    cameras = []
    every = [one for one in group.childNodes if one.nodeName == "camera"]
    for k, one in enumerate(every):
        tags = {child.nodeName: child for child in reversed(one.childNodes) if child.nodeType == child.ELEMENT_NODE}
        if one.getAttribute("calibrated").lower() == "false" or "intrinsic" not in tags:
            continue

        def number(tag: str, key: str, tags: Any = tags) -> float:
            return float(plain([tags[tag].getAttribute(key)])[0])

        left, top, right, bottom = (number("fov_video", key) for key in ("left", "top", "right", "bottom"))
        axes = np.array([number("transform", f"r{row}{column}") for row in "123" for column in "123"])
        u, _, vt = np.linalg.svd(axes.reshape(3, 3))
        names = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
        lens = dict(
            zip(
                ("k1", "k2", "p1", "p2", "k3"),
                (number("intrinsic", key) for key in (*names, "radialDistortion3")),
                strict=True,
            )
        )
        fu, fv, cu, cv = (
            number("intrinsic", key) / 64 for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
        )
        lens |= {"fx_px": fu, "fy_px": fv, "cx_px": cu - left, "cy_px": cv - top, "model": "opencv"}
        name = re.sub(r"[^A-Za-z0-9_ .-]", "_", one.getAttribute("serial") or f"cam_{k + 1}")
        cameras.append(
            {
                "name": name if re.match("[A-Za-z0-9_]", name) else f"cam_{name}",
                "size": [right - left + 1, bottom - top + 1],
                "lens": {**dict.fromkeys(ORDER, 0.0), **lens},
                "rotation": (u @ vt).T @ FLIP,
                "position": np.array([number("transform", axis) for axis in "xyz"]) * 1e-3,
            }
        )
    return cameras


def _openptv(folder: Path) -> Any:
    """Name, size, pose, and what of the lens is taken as it is: the others are fitted."""
    cameras = values_of(read_any_rig(folder / "cal", "openptv", ASKED)[0])
    return [{key: one[key] for key in ("name", "size", "position")} for one in cameras]


def _openptv_expected(folder: Path) -> Any:
    cameras = []
    lines = [line.strip() for line in (folder / "cal/ptv.par").read_text("utf-8-sig").splitlines() if line.strip()]
    numbers = plain(" ".join(lines[2 * int(lines[0]) + 4 :][:8]).split())
    for path in sorted((folder / "cal").glob("*.ori")):
        values = plain(path.read_text("utf-8-sig").split())
        added = plain(path.with_suffix(".addpar").read_text("utf-8-sig").split())
        if len(values) not in (18, 21) or len(added) != 7 or max(numbers[5:8]) > 1.001:
            raise ValueError("no camera of OpenPTV's in air")
        made = Rotation.from_euler("XYZ", values[3:6]).as_matrix()
        if np.abs(made - values[6:15].reshape(3, 3)).max() > 1e-3:
            raise ValueError("angles and matrix differ")
        cameras.append({"name": path.stem, "size": numbers[:2], "position": values[:3] * 1e-3})
    return cameras


def _selfcal_seed(folder: Path) -> None:
    source = DATA / "mcsc_selfcalib/flydra/sample_calibration"
    for name in ("camera1.Pmat.cal", "camera2.Pmat.cal", "basename1.rad", "basename2.rad"):
        (folder / name).write_bytes((source / name).read_bytes())
    for name in ("Res.dat", "camera_order.txt"):
        lines = (source / name).read_text().splitlines()
        (folder / name).write_text("\n".join(lines[:2]) + "\n")


def _selfcal(folder: Path) -> Any:
    options = RigFileOptions(unit="mm", max_residual_px=5.0)
    return [
        {key: one[key] for key in ("name", "size", "position")}
        for one in values_of(read_any_rig(folder, "multicamselfcal", options)[0])
    ]


def _selfcal_expected(folder: Path) -> Any:
    names = (folder / "camera_order.txt").read_text("utf-8-sig").split()
    sizes = plain((folder / "Res.dat").read_text("utf-8-sig").split()).reshape(-1, 2)
    cameras = []
    for k in range(len(sizes)):
        text = (folder / f"basename{k + 1}.rad").read_text("utf-8-sig")
        plain([one.split("=")[1] for one in text.split("\n") if re.match(r"\s*(K\d\d|kc\d)\s*=", one)])
        lines = (folder / f"camera{k + 1}.Pmat.cal").read_text("utf-8-sig").splitlines()
        p = plain(" ".join(one for one in lines if one.lstrip()[:1] not in ("#", "%")).split()).reshape(3, 4)
        name = names[k] if len(names) == len(sizes) else f"cam_{k + 1}"
        shown = re.sub(r"[^A-Za-z0-9_ .-]", "_", name)
        centre = -np.linalg.solve(p[:, :3], p[:, 3]) * 1e-3
        cameras.append({"name": shown, "size": sizes[k], "position": centre})
    return cameras


CALISCOPE = DATA / "caliscope_4cam/sessions/4_cam_recording/camera_array.toml"
READERS = (
    Reader(
        "aniposelib",
        (_seed("a.toml", "aniposelib", LENSES), *copied(DATA / "sleap_anipose/calibration.toml", "a.toml")),
        ("a.toml",),
        _read("a.toml", "aniposelib"),
        _dialect_expected,
    ),
    Reader(
        "caliscope",
        (_seed("a.toml", "caliscope", LENSES), *copied(CALISCOPE, "a.toml")),
        ("a.toml",),
        _read("a.toml", "caliscope"),
        _dialect_expected,
    ),
    *(
        Reader(
            f"opencv {suffix}",
            (_seed(f"a.{suffix}", "opencv", PINHOLES[:1]),),
            (f"a.{suffix}",),
            _read(f"a.{suffix}", "opencv"),
            _opencv_expected,
        )
        for suffix in ("yml", "xml", "json")
    ),
    Reader(
        "qtm",
        (
            _seed("a.qca.txt", "qtm", PINHOLES),
            *copied(DATA / "pose2sim_demo/Demo_SinglePerson/Calib.qca.txt", "a.qca.txt"),
        ),
        ("a.qca.txt",),
        _read("a.qca.txt", "qtm"),
        _qtm_expected,
    ),
    Reader("openptv", (_seed("cal", "openptv", PINHOLES[1:] * 2),), ("cal/*",), _openptv, _openptv_expected),
    *(
        (Reader("multicamselfcal", (_selfcal_seed,), ("*",), _selfcal, _selfcal_expected),)
        if (DATA / "mcsc_selfcalib/flydra").is_dir()
        else ()
    ),
)
