"""OpenPTV calibrations without refraction: ``NAME.ori`` and ``NAME.addpar`` a camera, ``ptv.par`` for the sensor.

``.ori``: centre X Y Z [mm]; omega, phi, kappa [rad] and the matrix that they make (columns: the camera's right, up
and backwards in the world); principal point xh yh and principal distance [mm]; the glass vector [mm]. ``.addpar``: k1
k2 k3 p1 p2 scx she. ``ptv.par``, in the same folder or ``parameters`` beside or in it: image size, pixel pitch and
the refractive indices, all 1 in air. Without it, size and pitch must be given, and the glass vector must be the
neutral one, (0, 0, d). ``ptv.par`` states one pixel size for all cameras. It is written with the shape that the
cameras' fx and fy require, the median where they differ.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.files.bounded import read_text
from mosca.data.files.whole_file import write_text
from mosca.data.rig import Camera, MoscaLens, Pose
from mosca.errors import InputError
from mosca.formats.rigs.lens_conversion import (
    CALIBRATION,
    Notes,
    RigFileOptions,
    checked_camera,
    fit_note,
    naming,
    numbers,
    rotation_of,
)
from mosca.formats.rigs.openptv_model import OpenPTVInterior, from_lens, pixel_shape, rolled, to_lens

FLIP = np.diag([1.0, -1.0, -1.0])
"""OpenPTV's camera looks along -z with y up; ours looks along z with y down."""
IMAGES = (".tif", ".tiff", ".bmp", ".png", ".jpg")
DEFAULT_PIXEL_MM = 0.01
"""Width of a pixel where no file states one. It scales all lengths in the camera alike, so that it cancels."""
LARGEST_ANGLE_MISFIT = 1e-4
"""Largest difference of the file's matrix, printed with 7 digits, from the matrix of its angles."""
SAME_HEIGHT = 1e-9
"""Relative difference of two pixel heights that counts as rounding."""
AIR = 1.001
"""Largest refractive index of a medium that is taken for air (air: 1.0003)."""
GLASS = "0.0 0.0 1.0"
LARGEST_MM = 1e5
"""Largest principal distance [mm]."""
Sensor = tuple[tuple[int, int], tuple[float, float]]


def read_openptv(path: Path, options: RigFileOptions) -> tuple[tuple[Camera, ...], Notes]:
    """Read one ``.ori`` with its ``.addpar``, or all of a folder, in the order of their names.

    Raises InputError where a file is missing or bad, the light is refracted, or size and pixel pitch are not known.
    """
    files = sorted(path.glob("*.ori")) if path.is_dir() else [path]
    if not files:
        raise InputError(f"{path}: no .ori file in it")
    sensor, notes = _sensor(files[0].parent, options)
    cameras = []
    for file in files:
        camera, more = _camera(file, sensor, options)
        cameras.append(camera)
        notes += more
    return tuple(cameras), notes


def write_openptv(cameras: tuple[Camera, ...], path: Path, options: RigFileOptions) -> Notes:
    """Write ``NAME.ori`` and ``NAME.addpar`` of each camera and ``ptv.par`` into the folder ``path``.

    A lens outside OpenPTV's model is approximated by it, within the limit. InputError for cameras of different image
    sizes: OpenPTV has one size for all.
    """
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise InputError(f"{path}: images of {len(sizes)} sizes given; OpenPTV's cameras share one")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; OpenPTV's files need a folder")
    path.mkdir(exist_ok=True)
    pixel_mm, notes = _pixel(cameras, options)
    for camera in cameras:
        with naming(camera):
            exchanged = from_lens(camera.lens, (camera.width, camera.height), pixel_mm)
        interior = exchanged.interior
        if exchanged.fit is not None:
            model = "OpenPTV's model, with one shape of pixels for all cameras"
            notes += (fit_note(camera, exchanged.fit, model, options),)
        write_text(path / f"{camera.name}.ori", _ori(camera, interior, exchanged.roll_rad))
        added = (interior.k1, interior.k2, interior.k3, interior.p1, interior.p2, interior.scx, interior.she)
        write_text(path / f"{camera.name}.addpar", " ".join(repr(float(value)) for value in added) + "\n")
    write_text(path / "ptv.par", _ptv_par(cameras, pixel_mm))
    return notes


def _sensor(folder: Path, options: RigFileOptions) -> tuple[Sensor | None, Notes]:
    """Return size and pitch from ``ptv.par``; None where there is none."""
    places = (folder, folder / "parameters", folder.parent / "parameters")
    path = next((place / "ptv.par" for place in places if (place / "ptv.par").is_file()), None)
    if path is None:
        note = f"{folder}: no ptv.par, which holds the refractive indices; air is taken"
        return None, (note,)
    lines = [line.strip() for line in read_text(path, CALIBRATION, "utf-8-sig").splitlines() if line.strip()]
    count = lines[0] if lines else ""
    first = 2 * int(count) + 4 if count.isdecimal() and len(count) < 4 else len(lines)
    if len(lines) < first + 8:
        raise InputError(f"{path}: {len(lines)} lines given; the count of cameras, two names each and 12 numbers")
    width, height, pitch_x, pitch_y, _, *indices = numbers(" ".join(lines[first : first + 8]), path)[:8]
    if max(indices) > AIR:
        raise InputError(
            f"{path}: refractive indices {indices} given; light that is refracted at a glass or water has no "
            "lens model here, only air (1, 1, 1) is allowed"
        )
    whole = width.is_integer() and height.is_integer()
    if not (whole and pitch_x > 0 and pitch_y > 0 and 0 < width <= 65535 and 0 < height <= 65535):
        raise InputError(
            f"{path}: image {width:.10g} x {height:.10g} px of {pitch_x:g} x {pitch_y:g} mm given; whole numbers of "
            "px from 1 to 65535 and a pitch above 0 are wanted"
        )
    return ((int(width), int(height)), (pitch_x, pitch_y)), ()


def _camera(path: Path, sensor: Sensor | None, options: RigFileOptions) -> tuple[Camera, Notes]:
    values = numbers(read_text(path, CALIBRATION, "utf-8-sig"), path)
    if len(values) not in (18, 21):
        raise InputError(
            f"{path}: {len(values)} numbers given; an .ori has 3 of the centre, 3 angles, 9 of the matrix, 3 of the "
            "interior orientation and 3 of the glass"
        )
    centre, angles, matrix, (xh, yh, c), glass = (
        np.array(values[a:b]) for a, b in ((0, 3), (3, 6), (6, 15), (15, 18), (18, 21))
    )
    if sensor is None:
        if options.size_px is None or options.pixel_mm is None:
            raise InputError(
                f"{path}: image size and pixel pitch stand in ptv.par, which is not there; give size_px and pixel_mm"
            )
        if len(glass) and (np.abs(glass[:2]) > 1e-6 * max(float(np.abs(glass).max()), 1e-300)).any():
            raise InputError(
                f"{path}: glass vector {glass.tolist()} given; only the neutral one (0 0 d) is allowed without a "
                "ptv.par that says that its refractive indices are 1"
            )
        sensor = (options.size_px, options.pixel_mm)
    beside = path.with_name(path.name.removesuffix(".ori") + ".addpar")
    added = numbers(read_text(beside, CALIBRATION, "utf-8-sig"), beside)
    if len(added) != 7:
        raise InputError(f"{beside}: {len(added)} numbers given; k1 k2 k3 p1 p2 scx she are wanted")
    if not (0 < c <= LARGEST_MM and added[5] > 0 and abs(added[6]) < 1):
        raise InputError(
            f"{path}: c = {c:g}, scx = {added[5]:g}, she = {added[6]:g} given; c above 0 and up to "
            f"{LARGEST_MM:g} mm, scx above 0, |she| < 1"
        )
    interior = OpenPTVInterior(sensor[1], sensor[0], float(c), float(xh), float(yh), *added)
    name = path.name.removesuffix(".ori")
    for ending in IMAGES:
        name = name.removesuffix(ending)
    ours = to_lens(interior)
    turn = _rotation(angles, matrix, path) @ FLIP @ rolled(ours.roll_rad)
    pose = Pose(turn, centre * options.metres("mm"))
    camera = checked_camera(Camera(name, *sensor[0], ours.lens, pose), str(path))
    notes: Notes = ()
    if interior.scx != 1:
        notes += (
            f"camera '{name}': scx = {interior.scx:g} taken for both axes, as liboptv 0.3 projects; earlier ones "
            "scale x alone: a rig that was calibrated with those comes out wrong",
        )
    if ours.fit is not None:
        model = "OpenCV's model" if camera.lens.model == "opencv" else "the Mosca model"
        notes += (fit_note(camera, ours.fit, f"{model} instead of OpenPTV's", options),)
    return camera, notes


def _rotation(angles: Array, matrix: Array, path: Path) -> Array:
    """Return the matrix of the angles, which has more digits; InputError where the two disagree."""
    given = rotation_of(matrix, str(path))
    made = np.asarray(Rotation.from_euler("XYZ", angles).as_matrix())
    misfit = float(np.abs(made - given).max())
    if misfit > LARGEST_ANGLE_MISFIT:
        raise InputError(
            f"{path}: omega, phi, kappa and the matrix differ by {misfit:.3g}; {LARGEST_ANGLE_MISFIT:g} is allowed"
        )
    return made


def _pixel(cameras: tuple[Camera, ...], options: RigFileOptions) -> tuple[tuple[float, float], Notes]:
    """Return width and height [mm] of the pixels: the known width, and the height that follows from fx and fy."""
    known = {camera.lens.mx_mm_per_px for camera in cameras if isinstance(camera.lens, MoscaLens)}
    notes: Notes = ()
    if options.pixel_mm is not None:
        width = options.pixel_mm[0]
    elif len(known) == 1:
        width = known.pop()
    else:
        width = DEFAULT_PIXEL_MM
        notes += (f"pixel pitch {width:g} mm taken; it only sets the unit of the principal distance (pixel_mm)",)
    shapes = []
    for camera in cameras:
        with naming(camera):
            shapes.append(pixel_shape(camera.lens))
    height = width * float(np.median(shapes))
    if options.pixel_mm is not None and abs(height / options.pixel_mm[1] - 1) > SAME_HEIGHT:
        notes += (
            f"pixel height {height:.9g} mm written instead of {options.pixel_mm[1]:g}: OpenPTV has no other place "
            "for the ratio of fx to fy",
        )
    return (width, height), notes


def _ori(camera: Camera, interior: OpenPTVInterior, roll_rad: float) -> str:
    pose = camera.world_from_camera
    matrix = pose.rotation @ rolled(-roll_rad) @ FLIP
    angles = Rotation.from_matrix(matrix).as_euler("XYZ")
    rows = [1e3 * pose.translation, angles, None, *matrix, None]
    rows += [np.array([interior.xh_mm, interior.yh_mm]), np.array([interior.c_mm]), None]
    lines = ["" if row is None else " ".join(repr(float(value)) for value in row) for row in rows]
    return "\n".join([*lines, GLASS]) + "\n"


def _ptv_par(cameras: tuple[Camera, ...], pixel_mm: tuple[float, float]) -> str:
    names = [line for camera in cameras for line in (f"img/{camera.name}", f"cal/{camera.name}")]
    size = [str(cameras[0].width), str(cameras[0].height), *(repr(float(one)) for one in pixel_mm)]
    # highpass, all cameras, tiff; size and pitch; field; three refractive indices and the glass's thickness
    lines = [str(len(cameras)), *names, "1", "0", "1", *size, "0", "1.0", "1.0", "1.0", "0.0"]
    return "\n".join(lines) + "\n"
