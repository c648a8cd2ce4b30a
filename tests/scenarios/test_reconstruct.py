"""From a folder of images to a tracks file, and error messages.

The images are drawn here: three pinhole cameras side by side with axes along z, so that a point's image is
``c + f (X - O) / Z``; two points move past three still lamps.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import refusal

from mosca.data.files.rig_file import write_rig
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.detection.detect import mean_background, minimum_background
from mosca.errors import InputError
from mosca.formats.tracks.tracks_csv import read_tracks_csv
from mosca.pipeline import run
from mosca.recording import open_recording
from mosca.synchronisation import Assembly
from scenarios.commands.reconstruct import BackgroundSpec, reconstruct_recording, recorded_backgrounds

WIDTH, HEIGHT, FOCAL = 160, 120, 400.0
PLACES = {"left": (-0.1, 0.0, 0.0), "middle": (0.0, 0.05, 0.0), "right": (0.1, 0.0, 0.0)}
LAMPS = np.array([[-0.15, -0.12, 2.0], [0.2, 0.1, 2.1], [0.1, -0.1, 1.9]])
FRAMES = 6
START, STEP = np.array([[-0.1, 0.05, 2.0], [0.1, 0.0, 2.05]]), np.array([0.01, 0.02, 0.0])
SETTINGS = """
[background]
kind = "minimum"
[match]
worst_sigma_m = 0.05  # the cameras stand close together
judge_sizes = false  # spots of one size at unlike distances
[volume]
low_m = [-1, -1, 1]
high_m = [1, 1, 3]
"""


def moving(frame: int) -> np.ndarray:
    return START + frame * STEP


def picture(place: tuple[float, float, float], frame: int) -> np.ndarray:
    """Gaussian spots of 1.2 px on a sky of 10 grey values."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    image = np.full((HEIGHT, WIDTH), 10.0)
    for x, y, z in np.concatenate([LAMPS, moving(frame)]) - place:
        u, v = (WIDTH - 1) / 2 + FOCAL * x / z, (HEIGHT - 1) / 2 + FOCAL * y / z
        image += 150 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 1.2**2))
    return np.rint(image.clip(0, 255)).astype(np.uint8)


def rig_of(turned: str = "") -> Rig:
    lens = OpenCVLens(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    back = np.diag([-1.0, 1.0, -1.0])
    return Rig(
        tuple(
            Camera(name, WIDTH, HEIGHT, lens, Pose(back if name == turned else np.eye(3), np.array(place)))
            for name, place in PLACES.items()
        )
    )


@pytest.fixture
def lab(tmp_path) -> Path:
    """A folder with a recording, its rig and its settings."""
    for name, place in PLACES.items():
        (tmp_path / "take" / name).mkdir(parents=True)
        for frame in range(FRAMES):
            cv2.imwrite(str(tmp_path / "take" / name / f"{frame:04}.tif"), picture(place, frame))
    write_rig(rig_of(), tmp_path / "rig.toml")
    (tmp_path / "settings.toml").write_text(SETTINGS)
    return tmp_path


def reconstruct(lab: Path, *overrides: str, out: str = "tracks.csv") -> list[str]:
    return reconstruct_recording(lab / "take", lab / "rig.toml", lab / out, 50.0, lab / "settings.toml", overrides)


def one_line(lab: Path, *words: str) -> str:
    """Run the command line in ``lab``; it must end with 2, one line, and no file more than before."""
    before = {path: path.stat().st_mtime_ns for path in lab.rglob("*")}
    line = refusal(*words, cwd=lab)
    assert {path: path.stat().st_mtime_ns for path in lab.rglob("*")} == before
    return line


def test_what_stands_still_is_taken_off(lab):
    reconstruct(lab)
    tracks = read_tracks_csv(lab / "tracks.csv")
    assert len(np.unique(tracks.track)) == 2
    assert len(tracks) == 2 * FRAMES
    for frame in range(FRAMES):
        found = tracks.xyz[tracks.frame == frame]
        apart = np.linalg.norm(found[:, None] - moving(frame)[None], axis=2)
        # 0.02 px of centroid at Z / f = 5 mm a pixel, in depth Z / base = 10 to 20 times that
        assert apart.min(axis=0).max() < 2e-3
    # the lamps are points like others where nothing is taken off
    reconstruct(lab, "background.kind=none", out="all.csv")
    assert len(np.unique(read_tracks_csv(lab / "all.csv").track)) == 5


def test_the_background_is_of_the_first_frames(lab):
    stack = np.array([picture(PLACES["left"], frame) for frame in range(FRAMES)])
    for frames in (1, 3, 100):
        made = {
            kind: recorded_backgrounds(lab / "take", rig_of(), 50.0, BackgroundSpec(kind=kind, frames=frames))
            for kind in ("minimum", "mean")
        }
        assert list(made["mean"]) == list(PLACES)
        np.testing.assert_array_equal(made["minimum"]["left"], stack[:frames].min(axis=0))
        np.testing.assert_array_equal(made["mean"]["left"], np.rint(stack[:frames].mean(axis=0)))
    assert recorded_backgrounds(lab / "take", rig_of(), 50.0, BackgroundSpec()) == {}


def test_backgrounds_by_hand():
    images = [np.array([[1, 9], [4, 4]], np.uint8), np.array([[3, 2], [4, 7]], np.uint8)]
    before = [image.copy() for image in images]
    assert minimum_background(images).tolist() == [[1, 2], [4, 4]]
    assert mean_background(images).tolist() == [[2, 6], [4, 6]]  # 5.5 is rounded to the even 6
    assert all((a == b).all() for a, b in zip(images, before, strict=True))
    assert minimum_background(iter(images)).dtype == np.uint8
    with pytest.raises(InputError, match="no images"):
        minimum_background([])
    with pytest.raises(InputError, match="image 1"):
        minimum_background([np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint16)])


def test_a_background_of_an_unknown_camera_or_size(lab):
    with open_recording(lab / "take", rig_of(), 50.0) as source:
        with pytest.raises(InputError, match="'rigth' given; the rig has left, middle, right"):
            next(run(source, rig_of(), backgrounds={"rigth": np.zeros((HEIGHT, WIDTH), np.uint8)}))
        with pytest.raises(InputError, match="camera 'left': background"):
            next(run(source, rig_of(), backgrounds={"left": np.zeros((4, 4), np.uint8)}))


def test_without_backgrounds_nothing_changes(lab):
    def points(backgrounds: dict[str, np.ndarray] | None) -> np.ndarray:
        with open_recording(lab / "take", rig_of(), 50.0) as source:
            return np.concatenate([s.points.xyz for s in run(source, rig_of(), None, Assembly(), backgrounds)])

    np.testing.assert_array_equal(points(None), points({}))
    black = {name: np.zeros((HEIGHT, WIDTH), np.uint8) for name in PLACES}
    # before a given background the slope that a target hides counts, too
    np.testing.assert_allclose(points(None), points(black), rtol=0, atol=5e-6)


def test_each_camera_s_sensor_is_told_of(lab):
    lines = reconstruct_recording(lab / "take", lab / "rig.toml", lab / "t.csv", 100.0, lab / "settings.toml", ())
    told = [line for line in lines if "learned from" in line]
    assert [line.split(":")[0] for line in told] == [f"camera '{name}'" for name in PLACES]
    # the pictures have no noise, and the brightest grey value is 160
    assert all("noise below 0.5 DN" in line and f"from {FRAMES} images" in line for line in told)
    assert all("8 bits, largest value" in line and "DN, not saturated" in line for line in told)


def test_a_cut_image_is_named_and_counted_and_the_run_goes_on(lab):
    victim = lab / "take" / "middle" / "0002.tif"
    victim.write_bytes(victim.read_bytes()[:1000])
    told = reconstruct(lab)
    assert "middle: 0 dropped, 1 corrupt, 0 late, 0 doubled" in told
    assert any("0002.tif" in line for line in told)
    tracks = read_tracks_csv(lab / "tracks.csv")
    assert len(np.unique(tracks.track)) == 2
    assert (tracks.n_cameras[tracks.frame == 2] == 2).all()
    assert len(tracks) == 2 * FRAMES


def test_a_camera_without_a_readable_image_for_its_background(lab):
    for frame in (0, 1):
        (lab / "take" / "right" / f"{frame:04}.tif").write_bytes(b"II*\0")
    words = "reconstruct take --rig rig.toml --settings settings.toml --out t.csv --fps 50 --set background.frames=2"
    line = one_line(lab, *words.split())
    assert "camera 'right'" in line
    assert "background.frames" in line


GOOD = {"recording": "take", "--rig": "rig.toml", "--out": "t.csv", "--settings": "settings.toml"}


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"recording": "tale"}, "tale: no such folder; did you mean 'take'?"),
        ({"recording": "empty"}, "no recording in it"),
        ({"--rig": "rgi.toml"}, "did you mean 'rig.toml'?"),
        ({"--rig": "apart.toml"}, "apart.toml: no two cameras see a common point"),
        ({"--rig": "other.toml"}, "nothing is called or ends with the rig's camera name 'far'"),
        ({"--out": "t.xlsx"}, "suffix '.xlsx' given; .npz, .csv, .parquet, .c3d, .trc are allowed"),
        ({"--out": "nowhere/t.csv"}, "no folder nowhere"),
        ({"--out": "folder.csv"}, "folder.csv: is a folder"),
        ({"--settings": "none.toml"}, "none.toml: no such file"),
        ({"--set": "detection.contrast=4"}, "unknown key 'detection.contrast'; did you mean 'contrast_dn'?"),
        ({"--set": "background.kind=median"}, "key 'background.kind': 'median' given"),
        ({"--set": "background.frames=0"}, "key 'background.frames': 0 given"),
        ({"--set": "match.judge_sizes=maybe"}, "key 'match.judge_sizes': 'maybe' given"),
        ({"--set": "detection.minimum_size_px=90"}, "settings.toml: detection: key 'minimum_size_px': 90"),
        ({"--fps": "0"}, "--fps 0"),
    ],
)
def test_bad_input_of_reconstruct(lab, changed, says):
    (lab / "empty").mkdir()
    (lab / "folder.csv").mkdir()
    two = Rig(rig_of(turned="right").cameras[1:])
    write_rig(two, lab / "apart.toml")
    write_rig(rig_of(), lab / "other.toml")
    text = (lab / "other.toml").read_text().replace('"left"', '"far"')
    (lab / "other.toml").write_text(text)
    words = {**GOOD, "--fps": "50", **changed}
    recording = words.pop("recording")
    line = one_line(lab, "reconstruct", recording, *sum(words.items(), ()))
    assert says in line


TARGET = """kind = "points"
unit = "mm"
size_px = [160, 120]
[[camera]]
name = "left"
file = "points.txt"
"""


@pytest.mark.parametrize(
    ("recording", "target", "out", "points", "says"),
    [
        ("tale", TARGET, "r.toml", "0 0 0 0 0\n", "tale: no such folder"),
        ("take", TARGET, "r.json", "0 0 0 0 0\n", "a rig file ends in .toml"),
        ("take", TARGET, "r.toml", None, "points.txt"),
        ("take", TARGET, "r.toml", "1 2 3\n", "points.txt"),
        ("take", TARGET, "r.toml", "1 2 3 4 5\n", "left"),
        ("take", TARGET, "r.toml", "500 2 3 4 5\n" * 9, "lie outside the image of 160 x 120 px"),
        ("take", TARGET.replace("unit", "units"), "r.toml", "", "did you mean 'unit'?"),
        ("take", TARGET.replace("mm", "inch"), "r.toml", "", "key 'unit': 'inch' given"),
    ],
)
def test_bad_input_of_calibrate(lab, recording, target, out, points, says):
    (lab / "target.toml").write_text(target)
    if points is not None:
        (lab / "take" / "points.txt").write_text(points)
    line = one_line(lab, "calibrate", recording, "--target", "target.toml", "--out", out)
    assert says in line


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("detection.minimum_size_px=35", "no detections: look at detection.false_alarms (0.01)"),
        ("match.worst_sigma_m=0.0001", "no points: look at the rig, [volume]"),
        ("track.worst_sigma_m=0.0001", "no tracks: look at track.worst_sigma_m (0.0001)"),
        ("track.confirm_weight=1000", "no tracks: look at track.confirm_weight (1000)"),
    ],
)
def test_no_tracks_says_where_to_look(lab, override, says):
    told = reconstruct(lab, override)
    assert any(line.startswith(says) for line in told)
    assert len(read_tracks_csv(lab / "tracks.csv")) == 0
