"""OpenPTV's files beside liboptv itself: the same pixels written, read, and written again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.camera.projection import image_grid, lens_directions, project
from mosca.data.rig import Camera, Lens, MoscaLens, OpenCVLens, Pose, Rig
from mosca.errors import InputError
from mosca.formats.rigs.openptv_model import OpenPTVInterior, openptv_directions, openptv_pixels, to_lens
from mosca.formats.rigs.rig_formats import RigFileOptions, read_any_rig, write_any_rig

SIZE = (1280, 1024)
CENTRED = OpenCVLens(1400.0, 1401.5, 639.5, 511.5, -0.12, 0.05, 7e-4, -3e-4, 0.01)
WIDE_PIXELS = OpenCVLens(1400.0, 1540.0, 651.0, 498.0)
SHEARED = MoscaLens(14.0, 633.2, 518.9, 0.01, 0.010005, a=5e-3)
AT = Pose(Rotation.from_euler("XYZ", [0.3, -1.1, 2.0]).as_matrix(), np.array([0.4, -2.0, 1.5]))
LOOSE = RigFileOptions(max_residual_px=5.0)


def liboptv():
    """Return liboptv's modules of calibrations, parameters, projection and transformations."""
    names = ("calibration", "parameters", "imgcoord", "transforms")
    why = "liboptv (optv on PyPI) is not installed here"
    return [pytest.importorskip(f"optv.{name}", reason=why) for name in names]


def control_of(pixel_mm: tuple[float, float]):
    """Return liboptv's control parameters of one camera in air."""
    _, parameters, _, _ = liboptv()
    control = parameters.ControlParams(1, image_size=SIZE, pixel_size=pixel_mm)
    media = control.get_multimedia_params()
    media.set_n1(1.0)
    media.set_layers([1.0], [1.0])
    media.set_n3(1.0)
    return control


def seen_by_liboptv(folder: Path, name: str, points_m: np.ndarray) -> np.ndarray:
    """Return where liboptv images points (n, 3) [m] with the files of a folder, in our pixels (n, 2)."""
    calibrations, _, imgcoord, transforms = liboptv()
    calibration = calibrations.Calibration()
    calibration.from_file(str(folder / f"{name}.ori"), str(folder / f"{name}.addpar"))
    lines = (folder / "ptv.par").read_text().split()
    first = 2 * int(lines[0]) + 4
    assert tuple(map(int, lines[first : first + 2])) == SIZE
    control = control_of((float(lines[first + 2]), float(lines[first + 3])))
    metric = imgcoord.image_coordinates(1000 * points_m, calibration, control.get_multimedia_params())
    return transforms.convert_arr_metric_to_pixel(metric, control) - 0.5


def most_px(note: str) -> float:
    """Return the largest distance [px] that a note on a fit states."""
    return float(note.split(" px at most")[0].split()[-1])


def points_before(pose: Pose) -> np.ndarray:
    return pose.transform(np.random.default_rng(3).uniform((-1, -1, 4), (1, 1, 6), (50, 3)))


@pytest.mark.parametrize("lens", [CENTRED, WIDE_PIXELS])
def test_liboptv_images_what_is_written(lens, tmp_path):
    rig = Rig((Camera("cam_0", *SIZE, lens, AT),))
    notes = write_any_rig(rig, tmp_path / "cal", "openptv", RigFileOptions(pixel_mm=(0.01, 0.01)))
    assert "pixel height" in notes[0]
    points = points_before(AT)
    theirs = seen_by_liboptv(tmp_path / "cal", "cam_0", points)
    np.testing.assert_allclose(project(rig.cameras[0], points), theirs, atol=1e-6)


def test_liboptv_images_what_is_written_of_a_shear(tmp_path):
    """Half of a Mosca lens's shear is a roll to OpenPTV; without distortion nothing is left."""
    rig = Rig((Camera("cam_0", *SIZE, SHEARED, AT),))
    notes = write_any_rig(rig, tmp_path / "cal", "openptv")
    assert "0.01" in (tmp_path / "cal" / "ptv.par").read_text().split()
    assert all(most_px(note) < 1e-6 for note in notes)
    points = points_before(AT)
    theirs = seen_by_liboptv(tmp_path / "cal", "cam_0", points)
    np.testing.assert_allclose(project(rig.cameras[0], points), theirs, atol=1e-6)
    again, _ = read_any_rig(tmp_path / "cal")
    np.testing.assert_allclose(project(again.cameras[0], points), theirs, atol=1e-6)


def test_cameras_of_other_shapes_share_one_as_well_as_they_can(tmp_path):
    """By hand: the ratios differ by 0.2 %, 0.1 % is left for each camera.

    Of it c gives x the part e and y the rest, e = 0.1 % h^2 / (w^2 + h^2), in least squares over the image: 0.23 px.
    """
    lenses = [OpenCVLens(1400.0, fy, 639.5, 511.5) for fy in (1400.0, 1402.8)]
    rig = Rig(tuple(Camera(f"cam_{k}", *SIZE, lens, AT) for k, lens in enumerate(lenses)))
    with pytest.raises(InputError, match="one shape of pixels for all cameras"):
        write_any_rig(rig, tmp_path / "cal", "openptv")
    notes = write_any_rig(rig, tmp_path / "cal", "openptv", LOOSE)
    notes = [note for note in notes if "fitted" in note]
    width, height = 640, 512
    e = 0.001 * height**2 / (width**2 + height**2)
    by_hand = np.hypot(e * width, (0.001 - e) * height) / np.sqrt(3)
    points = points_before(AT)
    for camera, note in zip(rig.cameras, notes, strict=True):
        # terms of the distortion take some of it
        assert 0.5 * by_hand < float(note.split(" px rms")[0].split()[-1]) <= 1.03 * by_hand
        off = seen_by_liboptv(tmp_path / "cal", camera.name, points) - project(camera, points)
        assert np.linalg.norm(off, axis=1).max() < 1.05 * most_px(note)


@st.composite
def interiors(draw, distorted: bool, scx: float | None = None):
    """An OpenPTV camera as calibrations leave them: everything a little off."""
    near = lambda size: draw(st.floats(-size, size, allow_subnormal=False))  # noqa: E731
    k1, k2, p1, p2 = (near(size) if distorted else 0.0 for size in (6e-4, 3e-6, 3e-5, 3e-5))
    wide = 1 + near(0.05) if scx is None else scx
    pixel_mm = (0.01 * (1 + near(0.05)), 0.01)
    return OpenPTVInterior(pixel_mm, SIZE, 14 + near(2), near(0.3), near(0.3), k1, k2, 0.0, p1, p2, wide, near(5e-3))


def files_of(folder: Path, one: OpenPTVInterior) -> None:
    """Write a camera in the files' own words, without the code under test."""
    angles = Rotation.from_matrix(AT.rotation @ np.diag([1.0, -1.0, -1.0])).as_euler("XYZ")
    matrix = Rotation.from_euler("XYZ", angles).as_matrix()
    numbers = [1000 * AT.translation, angles, *matrix, (one.xh_mm, one.yh_mm), (one.c_mm,), (0.0, 0.0, 1.0)]
    folder.mkdir(exist_ok=True)
    lines = [" ".join(repr(float(value)) for value in row) for row in numbers]
    (folder / "one.ori").write_text("\n".join(lines) + "\n")
    added = (one.k1, one.k2, one.k3, one.p1, one.p2, one.scx, one.she)
    (folder / "one.addpar").write_text(" ".join(map(repr, added)) + "\n")
    size = (*map(str, SIZE), *map(repr, one.pixel_mm))
    (folder / "ptv.par").write_text("\n".join(["1", "img", "cal", "1", "0", "1", *size, "0", "1", "1", "1", "0"]))


@settings(max_examples=20, deadline=None)
@given(interiors(distorted=False))
def test_a_camera_without_distortion_is_read_as_liboptv_images_it(tmp_path_factory, one):
    """Any scx, shear, principal point and shape of pixels: exact; and again after it was written by us."""
    folder = tmp_path_factory.mktemp("one")
    files_of(folder, one)
    points = points_before(AT)
    theirs = seen_by_liboptv(folder, "one", points)
    rig, notes = read_any_rig(folder)
    assert ["scx" in note for note in notes] == [True] * (one.scx != 1)
    np.testing.assert_allclose(project(rig.cameras[0], points), theirs, atol=1e-6)
    write_any_rig(rig, folder / "again", "openptv")
    np.testing.assert_allclose(seen_by_liboptv(folder / "again", "one", points), theirs, atol=1e-6)


@settings(max_examples=10, deadline=None)
@given(interiors(distorted=True))
def test_a_distorted_camera_is_read_as_liboptv_images_it(tmp_path_factory, one):
    """Our lens approximates OpenPTV's: within the residual that is stated, over the image."""
    folder = tmp_path_factory.mktemp("one")
    files_of(folder, one)
    rig, notes = read_any_rig(folder, options=LOOSE)
    stated = max((most_px(note) for note in notes if "fitted" in note), default=0)
    points = points_before(AT)
    theirs = seen_by_liboptv(folder, "one", points)
    inside = ((theirs >= -0.5) & (theirs <= np.array(SIZE) - 0.5)).all(axis=1)
    off = np.linalg.norm(project(rig.cameras[0], points) - theirs, axis=1)[inside]
    assert off.max() < 1.05 * stated + 1e-6
    # and again: what is written of our lens is within what that fit states
    notes = write_any_rig(rig, folder / "again", "openptv", LOOSE)
    more = max((most_px(note) for note in notes if "fitted" in note), default=0)
    again = np.linalg.norm(seen_by_liboptv(folder / "again", "one", points) - theirs, axis=1)[inside]
    assert again.max() < 1.05 * (stated + more) + 1e-6


@settings(max_examples=20, deadline=None)
@given(interiors(distorted=True))
def test_the_model_is_liboptvs_before_any_fit(one):
    """``distort_arr_brown_affine`` for our way to pixels; our way back is its inverse."""
    calibrations, _, _, transforms = liboptv()
    directions = lens_directions(OpenCVLens(1400.0, 1400.0, 639.5, 511.5), image_grid(*SIZE, 128.0))
    directions = directions / directions[:, 2:]
    calibration = calibrations.Calibration()
    calibration.set_radial_distortion(np.array([one.k1, one.k2, one.k3]))
    calibration.set_decentering(np.array([one.p1, one.p2]))
    calibration.set_affine_trans(np.array([one.scx, one.she]))
    flat = np.ascontiguousarray(one.c_mm * directions[:, :2] * (1, -1) + (one.xh_mm, one.yh_mm))
    metric = transforms.distort_arr_brown_affine(flat, calibration)
    theirs = transforms.convert_arr_metric_to_pixel(metric, control_of(one.pixel_mm)) - 0.5
    np.testing.assert_allclose(openptv_pixels(one, directions), theirs, atol=1e-8)
    np.testing.assert_allclose(openptv_directions(one, theirs), directions, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(interiors(distorted=True, scx=1.0))
def test_liboptvs_way_back_agrees_where_scx_is_one(one):
    """``distorted_to_flat`` from our pixels: the same rays, so that tracking there matches what we calibrated."""
    one = replace(one, she=0.0)
    calibrations, _, _, transforms = liboptv()
    calibration = calibrations.Calibration()
    calibration.set_primary_point(np.array([one.xh_mm, one.yh_mm, one.c_mm]))
    calibration.set_radial_distortion(np.array([one.k1, one.k2, one.k3]))
    calibration.set_decentering(np.array([one.p1, one.p2]))
    calibration.set_affine_trans(np.array([one.scx, one.she]))
    pixels = image_grid(*SIZE, 128.0)
    metric = transforms.convert_arr_pixel_to_metric(pixels + 0.5, control_of(one.pixel_mm))
    flat = transforms.distorted_to_flat(metric, calibration, tol=1e-12)
    ours = openptv_directions(one, pixels)
    np.testing.assert_allclose(flat / one.c_mm * (1, -1), ours[:, :2], atol=1e-6)


def test_a_shear_comes_as_a_mosca_lens_and_a_roll():
    """Closed form: tan(2 roll) = sin(she), a = tan(roll)."""
    one = OpenPTVInterior((0.01, 0.01), SIZE, 14.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.01)
    found = to_lens(one)
    lens: Lens = found.lens
    assert isinstance(lens, MoscaLens)
    assert found.fit is None
    assert lens.a == pytest.approx(np.tan(found.roll_rad), rel=1e-12)
    assert np.tan(2 * found.roll_rad) == pytest.approx(np.sin(0.01), rel=1e-12)
