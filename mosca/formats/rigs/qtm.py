"""Qualisys calibrations (``.qca.txt``, an XML file that QTM exports), read and written.

A camera holds ``fov_video`` (left, top, right, bottom [px], counted from 0), ``transform`` (centre x, y, z [mm]; r11
... r33, whose rows are the axes right, up and backwards in the world) and ``intrinsic``: focal lengths and principal
point in 1/64 px of the whole sensor; radial and tangential distortion are OpenCV's k1, k2, k3, p1, p2, which have no
unit and are not scaled. It is not published which point of a pixel has integer coordinates: the centre is assumed, so
the principal point is uncertain by half a pixel.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from mosca.data.files.bounded import read_bytes
from mosca.data.files.decimals import real
from mosca.data.files.whole_file import whole_file
from mosca.data.rig import Camera, OpenCVLens, Pose
from mosca.errors import InputError
from mosca.formats.rigs.lens_conversion import Notes, RigFileOptions, as_opencv, checked_camera, rotation_of

SUBPIXELS = 64.0
"""QTM states intrinsic parameters in 1/64 of a pixel."""
# QTM's optical axis is -z with y up; ours is z with y down
FLIP = np.diag([1.0, -1.0, -1.0])
KEYS = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2", "radialDistortion3")
AXES = [f"r{row}{column}" for row in "123" for column in "123"]
Element = ElementTree.Element


def read_qtm(path: Path, options: RigFileOptions) -> tuple[tuple[Camera, ...], Notes]:
    """Read a ``.qca.txt``; cameras that are not calibrated are left out with a note.

    Raises InputError for what is no such file, a missing or bad number, skew, or no calibrated camera.
    """
    root = _root(path)
    cameras, notes = [], []
    for k, element in enumerate(root.iterfind("cameras/camera")):
        name = element.get("serial") or f"cam_{k + 1}"
        where = f"{path}: camera '{name}'"
        if element.get("calibrated", "true").lower() == "false" or element.find("intrinsic") is None:
            notes.append(f"camera '{name}' is not calibrated and is left out")
            continue
        cameras.append(_camera(element, name, where, options))
        if element.get("viewrotation", "0") not in ("0", ""):
            notes.append(f"camera '{name}': viewrotation = {element.get('viewrotation')} turns QTM's view only")
        resolution = element.get("video_resolution")
        if resolution and resolution.rstrip("pi") not in (str(cameras[-1].width), str(cameras[-1].height)):
            notes.append(
                f"camera '{name}': video_resolution is {resolution}, the calibration is of "
                f"{cameras[-1].width} x {cameras[-1].height} px; smaller images need their own intrinsics"
            )
    if not cameras:
        raise InputError(f"{path}: no calibrated camera in it")
    return tuple(cameras), tuple(notes)


def write_qtm(cameras: tuple[Camera, ...], path: Path, options: RigFileOptions) -> Notes:
    """Write a ``.qca.txt``; a lens beyond OpenCV's k1, k2, k3, p1, p2 is fitted by them, within the limit."""
    root = ElementTree.Element("calibration", type="regular", source="mosca")
    ElementTree.SubElement(root, "results", {"std-dev": "0", "min-max-diff": "0"})
    group = ElementTree.SubElement(root, "cameras")
    notes: Notes = ()
    for camera in cameras:
        lens, more = as_opencv(camera, options, coefficients=5)
        notes += more
        _add(group, camera, lens)
    ElementTree.indent(root)
    with whole_file(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    return notes


class _PlainTree(ElementTree.TreeBuilder):
    """A tree of elements alone: no document type, so no entities either, which could stand for any text or file."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse a document type."""
        raise ValueError(f"<!DOCTYPE {name[:40]}> stands in it")


def _root(path: Path) -> Element:
    try:
        root = ElementTree.fromstring(read_bytes(path), ElementTree.XMLParser(target=_PlainTree()))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; a Qualisys .qca.txt is wanted") from None
    except (OSError, ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path}: not an XML file as QTM writes it: {error}") from None
    if root.tag != "calibration" or root.find("cameras") is None:
        raise InputError(f"{path}: <{root.tag}> stands where QTM's <calibration> with <cameras> is wanted")
    return root


def _camera(element: Element, name: str, where: str, options: RigFileOptions) -> Camera:
    left, top, right, bottom = (
        _number(element, "fov_video", key, where) for key in ("left", "top", "right", "bottom")
    )
    at = {key: _number(element, "transform", key, where) for key in (*AXES, "x", "y", "z")}
    own = {key: _number(element, "intrinsic", key, where) for key in KEYS}
    fu, fv, cu, cv = (
        _number(element, "intrinsic", key, where) / SUBPIXELS
        for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    skew = _number(element, "intrinsic", "skew", where, missing=0.0)
    if skew != 0:
        raise InputError(f'{where}: <intrinsic skew="{skew:g}"> given; only 0 is allowed')
    width, height = right - left + 1, bottom - top + 1
    if not (0 < width <= 65535 and 0 < height <= 65535 and width == int(width) and height == int(height)):
        raise InputError(f"{where}: <fov_video> of {width:g} x {height:g} px given; whole numbers of px are wanted")
    lens = OpenCVLens(fu, fv, cu - left, cv - top, *(own[key] for key in KEYS))
    backwards = rotation_of(np.array([at[key] for key in AXES]), f"{where}: <transform>")
    centre = np.array([at["x"], at["y"], at["z"]]) * options.metres("mm")
    pose = Pose(backwards.T @ FLIP, centre)
    return checked_camera(Camera(name, int(width), int(height), lens, pose), where)


def _number(element: Element, tag: str, key: str, where: str, missing: float | None = None) -> float:
    child = element.find(tag)
    text = None if child is None else child.get(key)
    if text is None and missing is not None:
        return missing
    try:
        value = real(text) if text is not None else np.nan
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{where}: <{tag} {key}> = {'nothing' if text is None else text[:40]!r}; a number is wanted")
    return value


def _add(group: Element, camera: Camera, lens: OpenCVLens) -> None:
    element = ElementTree.SubElement(
        group, "camera", {"active": "1", "calibrated": "true", "serial": camera.name, "viewrotation": "0"}
    )
    view = {"left": "0", "top": "0", "right": str(camera.width - 1), "bottom": str(camera.height - 1)}
    for tag in ("fov_marker", "fov_marker_max", "fov_video", "fov_video_max"):
        ElementTree.SubElement(element, tag, view)
    axes = (camera.world_from_camera.rotation @ FLIP).T
    place = dict(zip("xyz", 1e3 * camera.world_from_camera.translation, strict=True))
    turn = dict(zip(AXES, axes.ravel(), strict=True))
    ElementTree.SubElement(element, "transform", {key: repr(float(v)) for key, v in {**place, **turn}.items()})
    values = {
        "focalLengthU": SUBPIXELS * lens.fx_px,
        "focalLengthV": SUBPIXELS * lens.fy_px,
        "centerPointU": SUBPIXELS * lens.cx_px,
        "centerPointV": SUBPIXELS * lens.cy_px,
        "skew": 0.0,
        "sensorMinU": 0.0,
        "sensorMinV": 0.0,
        "sensorMaxU": SUBPIXELS * (camera.width - 1),
        "sensorMaxV": SUBPIXELS * (camera.height - 1),
        **dict(zip(KEYS, (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3), strict=True)),
    }
    ElementTree.SubElement(element, "intrinsic", {key: repr(float(value)) for key, value in values.items()})
