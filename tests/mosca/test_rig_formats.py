"""Calibrations of other programs, read and written: outside witnesses, round trips on rays, fuzz."""

import csv
import os
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mosca.camera.projection import image_grid, lens_directions, lens_pixels, project
from mosca.data.rig import Camera, FisheyeLens, Lens, MoscaLens, OpenCVLens, Pose, Rig
from mosca.errors import InputError
from mosca.formats.rigs.rig_formats import FORMATS, RigFileOptions, format_of, read_any_rig, write_any_rig

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
QTM = DATA / "pose2sim_demo" / "Demo_SinglePerson" / "Calib.qca.txt"
CALISCOPE = DATA / "caliscope_4cam" / "sessions" / "4_cam_recording"
SELFCAL = DATA / "mcsc_selfcalib" / "pymvg" / "external" / "mcsc" / "mcsc_output_20130726"
SIZE = (1280, 1024)
BROWN = OpenCVLens(1400.0, 1401.5, 633.2, 518.9, -0.12, 0.05, 7e-4, -3e-4, 0.01)
CENTRED = OpenCVLens(1400.0, 1401.5, 639.5, 511.5, -0.12, 0.05, 7e-4, -3e-4, 0.01)
FULL = OpenCVLens(
    1400.0, 1401.5, 633.2, 518.9, -0.12, 0.05, 7e-4, -3e-4, 0.01, 0.1, -0.02, 0.01,
    1e-3, -2e-3, 3e-4, 1e-3, 0.02, -0.01,
)  # fmt: skip
FISHEYE = FisheyeLens(480.0, 481.0, 641.0, 509.0, 0.01, -0.002, 0.0005, -1e-4)
MOSCA = MoscaLens(14.0, 633.2, 518.9, 0.01, 0.010005, 2e-4, -3e-5, 1e-8)
# name of the written file; which lens models it holds as they are
PLACES = {
    "mosca": ("rig.toml", (BROWN, FULL, FISHEYE, MOSCA)),
    "aniposelib": ("calibration.toml", (BROWN, FULL, FISHEYE)),
    "caliscope": ("camera_array.toml", (BROWN, FULL, FISHEYE)),
    "opencv": ("cameras", (BROWN, FULL, FISHEYE)),
    "qtm": ("calibration.qca.txt", (BROWN,)),
    "openptv": ("cal", (CENTRED, OpenCVLens(1400.0, 1401.5, 633.2, 518.9))),
}


def pose(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 3, 3))


def rig_of(*lenses: Lens) -> Rig:
    return Rig(tuple(Camera(f"cam_{k}", *SIZE, lens, pose(k)) for k, lens in enumerate(lenses)))


def ray_distance_px(one: Camera, other: Camera) -> float:
    """Return the largest distance [px] of ``one``'s pixels from where ``other`` images their rays 5 m away."""
    grid = image_grid(one.width, one.height, 64.0)
    far = one.world_from_camera.transform(5 * lens_directions(one.lens, grid))
    return float(np.linalg.norm(project(other, far) - grid, axis=1).max())


@pytest.mark.parametrize("name", PLACES)
def test_what_a_format_holds_comes_back_on_rays(name, tmp_path):
    place, lenses = PLACES[name]
    rig = rig_of(*lenses)
    path = tmp_path / place
    options = RigFileOptions(pixel_mm=(0.0055, 0.0055))
    notes = write_any_rig(rig, path, name, options)
    assert not [note for note in notes if "fitted" in note]
    again, notes = read_any_rig(path)
    assert notes == ()
    assert again.names == rig.names
    for one, other in zip(rig.cameras, again.cameras, strict=True):
        assert (one.width, one.height) == (other.width, other.height)
        assert ray_distance_px(one, other) < 1e-9
        shift = one.world_from_camera.translation - other.world_from_camera.translation
        assert np.abs(shift).max() < 1e-12


@pytest.mark.parametrize("name", [n for n in PLACES if n not in ("mosca", "qtm")])
def test_other_lenses_are_fitted_with_the_residual_stated(name, tmp_path):
    rig = rig_of(MOSCA)
    notes = write_any_rig(rig, tmp_path / PLACES[name][0], name, RigFileOptions(max_residual_px=0.5))
    note = next(n for n in notes if "fitted" in n)
    stated = float(note.split(" px at most")[0].split()[-1])
    again, _ = read_any_rig(tmp_path / PLACES[name][0], options=RigFileOptions(max_residual_px=0.5))
    far = lens_directions(MOSCA, image_grid(*SIZE))
    off = np.linalg.norm(lens_pixels(again.cameras[0].lens, far) - image_grid(*SIZE), axis=1)
    # OpenPTV's own model is fitted when it is written and OpenCV's to that when it is read
    assert off.max() == pytest.approx(stated, rel=0.05) or (name == "openptv" and off.max() < 0.5)


@pytest.mark.parametrize("name", ["aniposelib", "qtm", "opencv", "openptv"])
def test_a_lens_beyond_the_limit_is_refused(name, tmp_path):
    sheared = MoscaLens(14.0, 633.2, 518.9, 0.01, 0.010005, a=5e-3)
    # OpenPTV's model has a shear itself, and no rays from beside the camera
    wrong = rig_of(FISHEYE if name == "openptv" else sheared)
    what = r"mosca lens fitted by .* px rms .*; 0.1 px allowed" if name != "openptv" else "90 deg"
    with pytest.raises(InputError, match=f"cam_0': .*{what}"):
        write_any_rig(wrong, tmp_path / PLACES[name][0], name)


def test_opencv_projects_what_its_file_holds(tmp_path):
    """Witness: cv2.projectPoints with the keys as OpenCV itself reads them."""
    rig = rig_of(FULL)
    write_any_rig(rig, tmp_path / "one.yml", "opencv")
    storage = cv2.FileStorage(str(tmp_path / "one.yml"), cv2.FILE_STORAGE_READ)
    keys = ("R", "T", "camera_matrix", "distortion_coefficients")
    turn, shift, matrix, coefficients = (storage.getNode(key).mat() for key in keys)
    points = rig.cameras[0].world_from_camera.transform(
        np.random.default_rng(1).uniform((-1, -1, 4), (1, 1, 6), (50, 3))
    )
    pixels = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], shift, matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(project(rig.cameras[0], points), pixels, atol=1e-8)
    assert storage.getNode("image_width").real() == SIZE[0]


def test_a_file_that_opencv_wrote_is_read(tmp_path):
    """Stereo, as OpenCV's sample writes it; witness: cv2.projectPoints."""
    rng = np.random.default_rng(2)
    matrix = np.array([[900.0, 0, 650], [0, 905, 500], [0, 0, 1]])
    coefficients = np.array([[-0.2, 0.1, 1e-3, -1e-3, 0.02]])
    turn, shift = Rotation.from_rotvec([0.05, -0.4, 0.02]).as_matrix(), np.array([[-500.0], [3.0], [60.0]])
    path = tmp_path / "stereo.xml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in (("M1", matrix), ("D1", 0 * coefficients), ("M2", matrix), ("D2", coefficients)):
        storage.write(key, value)
    storage.write("R", turn)
    storage.write("T", shift)
    storage.release()
    assert format_of(path) == "opencv"
    with pytest.raises(InputError, match="image_width"):
        read_any_rig(path)
    rig, notes = read_any_rig(path, options=RigFileOptions(size_px=SIZE, unit="mm"))
    assert "world is the first camera's" in notes[0]
    points_m = rng.uniform((-0.3, -0.3, 1.5), (0.3, 0.3, 2.5), (40, 3))
    seen = cv2.projectPoints(1000 * points_m, cv2.Rodrigues(turn)[0], shift, matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(project(rig.cameras[1], points_m), seen, atol=1e-8)


def test_openptv_by_hand(tmp_path):
    """A file written out by hand and its equations (``mosca.formats.rigs.openptv_model``) worked out step by step."""
    (tmp_path / "cam1.tif.ori").write_text(
        "100.0 -50.0 800.0\n 0.0 0.0 0.0\n\n 1 0 0\n 0 1 0\n 0 0 1\n\n 0.0 0.0\n 70.0\n\n 0 0 1\n"
    )
    (tmp_path / "cam1.tif.addpar").write_text("1e-5 0 0 0 2e-6 1.001 0\n")
    with pytest.raises(InputError, match="size_px and pixel_mm"):
        read_any_rig(tmp_path)
    rig, notes = read_any_rig(tmp_path, options=RigFileOptions(size_px=(1280, 1024), pixel_mm=(0.012, 0.012)))
    assert "refractive" in notes[0]
    assert "scx = 1.001 taken for both axes" in notes[1]
    assert rig.names == ("cam1",)
    # the point (120, -20, 0) mm: 20 right of the camera, 30 above it, 800 before it
    x, y = 70 * 20 / 800, 70 * 30 / 800
    r2 = x**2 + y**2
    xd = x * (1 + 1e-5 * r2) + 2 * 2e-6 * x * y
    yd = y * (1 + 1e-5 * r2) + 2e-6 * (r2 + 2 * y**2)
    by_hand = [640 + 1.001 * xd / 0.012 - 0.5, 512 - 1.001 * yd / 0.012 - 0.5]
    np.testing.assert_allclose(project(rig.cameras[0], np.array([[0.12, -0.02, 0]]))[0], by_hand, atol=1e-9)


def test_openptv_with_a_principal_point_is_fitted(tmp_path):
    """Its distortion is about the sensor's middle: OpenCV's model then leaves a stated residual."""
    (tmp_path / "a.ori").write_text("0 0 900\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0.05 -0.03\n70\n0 0 1\n")
    (tmp_path / "a.addpar").write_text("-3e-5 1e-8 0 0 0 1 0\n")
    options = RigFileOptions(size_px=(1280, 1024), pixel_mm=(0.012, 0.012))
    _, notes = read_any_rig(tmp_path, options=options)
    assert "fitted" in notes[-1]


def test_light_that_is_refracted_is_refused(tmp_path):
    write_any_rig(rig_of(CENTRED), tmp_path / "cal", "openptv")
    text = (tmp_path / "cal" / "ptv.par").read_text()
    (tmp_path / "cal" / "ptv.par").write_text(text.replace("1.0\n1.0\n1.0\n", "1.0\n1.46\n1.33\n"))
    with pytest.raises(InputError, match="refractive indices"):
        read_any_rig(tmp_path / "cal")
    (tmp_path / "cal" / "ptv.par").unlink()
    ori = tmp_path / "cal" / "cam_0.ori"
    ori.write_text(ori.read_text().replace("0.0 0.0 1.0", "3.0 4.0 60.0"))
    with pytest.raises(InputError, match="glass vector"):
        read_any_rig(tmp_path / "cal", options=RigFileOptions(size_px=SIZE, pixel_mm=(0.01, 0.01)))


@pytest.mark.data
@pytest.mark.skipif(not QTM.is_file(), reason=f"no Pose2Sim demo in {DATA} (set MOSCA_DATA)")
def test_a_qualisys_file_as_pose2sim_converts_it(tmp_path):
    """Witnesses: Pose2Sim's own conversion of this file (its issue 98), and focal lengths from checkerboards."""
    rig, _ = read_any_rig(QTM)
    assert format_of(QTM) == "qtm"
    turns = [
        (1.68827548, 1.04832205, -0.41955852),
        (1.34975875, 1.59638091, -1.19832858),
        (0.81096549, -2.19721293, 1.37602778),
    ]
    shifts = [
        (0.32110489, 0.95633206, 2.89071305),
        (-0.11152829, 0.77661848, 3.06755196),
        (-0.79348039, 0.32283594, 4.35351487),
    ]
    principal = [(532.97369384375, 948.137390140625), (534.494567875, 963.225891109375), (513.20837403, 955.00512695)]
    for camera, turn, shift, centre in zip(rig.cameras[:3], turns, shifts, principal, strict=True):
        camera_from_world = camera.world_from_camera.inverse()
        np.testing.assert_allclose(Rotation.from_matrix(camera_from_world.rotation).as_rotvec(), turn, atol=1e-7)
        np.testing.assert_allclose(camera_from_world.translation, shift, atol=1e-7)
        np.testing.assert_allclose((camera.lens.cx_px, camera.lens.cy_px), centre, atol=1e-7)
        assert (camera.width, camera.height) == (1088, 1920)
    # cv2.calibrateCamera on the demo's checkerboard images: SOURCE.md
    for camera, board in zip(rig.cameras, (1673, 1679, 1677, 1700), strict=True):
        assert camera.lens.fx_px == pytest.approx(board, rel=0.016)
    write_any_rig(rig, tmp_path / "again.qca.txt", "qtm")
    again, _ = read_any_rig(tmp_path / "again.qca.txt")
    assert max(ray_distance_px(a, b) for a, b in zip(rig.cameras, again.cameras, strict=True)) < 1e-9


@pytest.mark.data
@pytest.mark.skipif(not CALISCOPE.is_dir(), reason=f"no Caliscope session in {DATA} (set MOSCA_DATA)")
@pytest.mark.parametrize("name", ["mosca", "aniposelib", "caliscope", "opencv", "qtm", "openptv"])
def test_shipped_corners_meet_through_every_format(name, tmp_path):
    """Witness: the shipped corners, OpenCV's undistortion and projection, and a linear triangulation.

    SOURCE.md has 0.46 px median and 1.57 px at 95 %.
    """
    rig, notes = read_any_rig(CALISCOPE / "camera_array.toml")
    assert notes == ()
    options = RigFileOptions(max_residual_px=8.0)
    notes = write_any_rig(rig, tmp_path / PLACES[name][0], name, options)
    again, more = read_any_rig(tmp_path / PLACES[name][0], options=options)
    assert bool([note for note in notes + more if "fitted" in note]) == (name == "openptv")
    distance = reprojection_px(again, CALISCOPE / "calibration" / "extrinsic" / "xy.csv")
    print(name, np.median(distance), np.quantile(distance, 0.95), notes + more)
    if name != "openptv":
        assert np.median(distance) < 0.465
        assert np.quantile(distance, 0.95) < 1.575
    else:
        # fx / fy differs by 0.9 % between these cameras, and OpenPTV has one shape of pixels for all of them
        assert np.median(distance) < 0.6


def reprojection_px(rig: Rig, corners: Path) -> np.ndarray:
    seen: dict[tuple[int, int], list[tuple[Camera, np.ndarray]]] = {}
    with corners.open(newline="") as file:
        for row in csv.DictReader(file):
            pixel = np.array([float(row["img_loc_x"]), float(row["img_loc_y"])])
            key = int(row["sync_index"]), int(row["keypoint_id"])
            seen.setdefault(key, []).append((rig.camera(f"cam_{row['cam_id']}"), pixel))
    distance = []
    for views in (one for one in seen.values() if len(one) > 1):
        rows, parts = [], []
        for camera, pixel in views:
            assert isinstance(camera.lens, OpenCVLens)
            lens, inverse = camera.lens, camera.world_from_camera.inverse()
            matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
            coefficients = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
            x, y = cv2.undistortPoints(pixel[None, None], matrix, coefficients)[0, 0]
            across = np.column_stack([inverse.rotation, inverse.translation])
            rows += [x * across[2] - across[0], y * across[2] - across[1]]
            parts.append((cv2.Rodrigues(np.array(inverse.rotation))[0], inverse.translation, matrix, coefficients))
        point = np.linalg.svd(rows)[2][-1]
        for (_, pixel), part in zip(views, parts, strict=True):
            again = cv2.projectPoints((point[:3] / point[3])[None], *part)[0][0, 0]
            distance.append(np.hypot(*(again - pixel)))
    return np.array(distance)


@pytest.mark.data
@pytest.mark.skipif(not SELFCAL.is_dir(), reason=f"no MultiCamSelfCal result in {DATA} (set MOSCA_DATA)")
def test_multicamselfcal_centres_and_stated_residual():
    """Witness: centres from the null vectors of the shipped matrices; the skew makes a residual, which is stated."""
    with pytest.raises(InputError, match=r"0\.1 px allowed"):
        read_any_rig(SELFCAL)
    rig, notes = read_any_rig(SELFCAL, options=RigFileOptions(max_residual_px=10.0))
    assert rig.names == ("Basler_21275576", "Basler_21275577", "Basler_21283674", "Basler_21283677")
    assert sum("px rms" in note for note in notes) == 4
    for k, camera in enumerate(rig.cameras):
        matrix = np.loadtxt(SELFCAL / f"camera{k + 1}.Pmat.cal")
        null = np.linalg.svd(matrix)[2][-1]
        np.testing.assert_allclose(camera.world_from_camera.translation, null[:3] / null[3], rtol=1e-6)
    points = np.loadtxt(SELFCAL / "points.dat").reshape(4, 3, -1)
    assert np.isfinite(points).any()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.qca.txt", "<calibration><cameras/></calibration>", "no calibrated camera"),
        ("a.qca.txt", "<calibration>", "not an XML file"),
        ("a.yml", "%YAML:1.0\n---\nK: 3\n", "'K' holds 1 values; 9 finite numbers"),
        ("a.yml", "%YAML:1.0\n---\nimage_width: 3\n", "'camera_matrix' is missing"),
        ("a.ori", "1 2 x", "'x' stands where a number is wanted"),
        ("a.ori", "1 2 3", "3 numbers given"),
        ("a.toml", "nonsense = 1", "unknown key"),
        ("a.dat", "1 2 3", "none of the calibrations that are read"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(name, text, message, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_any_rig(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_unknown_and_read_only_formats_are_named(tmp_path):
    with pytest.raises(InputError, match="'vicon' is unknown"):
        read_any_rig(tmp_path, "vicon")
    with pytest.raises(InputError, match="only read"):
        write_any_rig(rig_of(BROWN), tmp_path, "multicamselfcal")
    assert set(FORMATS) >= {"aniposelib", "caliscope", "opencv", "qtm", "openptv"}


def _changed(original: bytes, position: float, cut: float, put: bytes) -> bytes:
    at = int(position * len(original))
    return original[:at] + put + original[at + int(cut * 40) :]


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict[str, tuple[str, bytes]]:
    folder = tmp_path_factory.mktemp("written")
    found = {}
    for name, file in (("aniposelib", "a.toml"), ("opencv", "a.yml"), ("qtm", "a.qca.txt"), ("openptv", "cal")):
        write_any_rig(rig_of(CENTRED), folder / file, name)
        path = folder / file if name != "openptv" else folder / "cal" / "cam_0.ori"
        found[name] = (path.name, path.read_bytes())
    xml = folder / "a.xml"
    write_any_rig(rig_of(CENTRED), xml, "opencv")
    found["opencv xml"] = (xml.name, xml.read_bytes())
    return found


@pytest.mark.parametrize("name", ["aniposelib", "opencv", "opencv xml", "qtm", "openptv"])
@settings(max_examples=60, deadline=None)
@given(
    position=st.floats(0, 0.999),
    cut=st.floats(0, 1),
    put=st.one_of(st.binary(max_size=30), st.sampled_from([b"nan", b"-1e400", b"1e308", b"[", b"}", b"<a", b"\0"])),
)
def test_damaged_files_are_input_errors(name, written, position, cut, put):
    file, original = written[name]
    _read_or_refuse(file, _changed(original, position, cut, put))


@pytest.mark.parametrize("file", ["a.toml", "a.yml", "a.xml", "a.json", "a.qca.txt", "a.ori", "ptv.par"])
@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_input_errors(file, data):
    head = {"a.yml": b"%YAML:1.0\n", "a.xml": b"<opencv_storage>", "a.json": b"{", "a.qca.txt": b"<calibration>"}
    _read_or_refuse(file, data)
    _read_or_refuse(file, head.get(file, b"") + data)


def _read_or_refuse(file: str, data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / file
        path.write_bytes(data)
        if file.endswith(".ori"):
            path.with_suffix(".addpar").write_text("0 0 0 0 0 1 0\n")
        if file == "ptv.par":
            (Path(folder) / "a.ori").write_text("0 0 9\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0\n70\n")
            (Path(folder) / "a.addpar").write_text("0 0 0 0 0 1 0\n")
            path = Path(folder)
        said = ""
        try:
            rig, _ = read_any_rig(path, options=RigFileOptions(size_px=SIZE, pixel_mm=(0.01, 0.01)))
            assert all(np.isfinite(camera.world_from_camera.translation).all() for camera in rig.cameras)
        except InputError as error:
            said = str(error)
        assert "\n" not in said
