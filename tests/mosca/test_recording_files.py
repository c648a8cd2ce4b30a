"""Image folders, videos and frames.csv read as recordings."""

import os
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.errors import InputError
from mosca.recording import Recording, open_recording
from mosca.recording.images import decode_image, what_is_missing
from mosca.recording.stamps import read_stamps
from mosca.synchronisation import Assembly, assemble

DATA = Path(os.environ.get("MOSCA_DATA", Path(__file__).parents[3] / "shared" / "data"))
WIDTH, HEIGHT = 40, 30


def picture(seed: int, dtype: type = np.uint8, width: int = WIDTH) -> np.ndarray:
    top = 256 if dtype == np.uint8 else 65536
    return np.random.default_rng(seed).integers(0, top, (HEIGHT, width)).astype(dtype)


def write_images(folder: Path, numbers: list[int], pattern: str = "{:06d}.png", seed: int = 0) -> None:
    folder.mkdir(parents=True)
    for number in numbers:
        cv2.imwrite(str(folder / pattern.format(number)), picture(seed + number))


def rig_of(*names: str, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Rig:
    lens = OpenCVLens(100, 100, 20, 15)
    return Rig(tuple(Camera(name, *size, lens, Pose(np.eye(3), np.zeros(3))) for name in names))


def read(recording: Recording) -> list[Frame]:
    with recording:
        return list(recording)


def states(frames: list[Frame]) -> dict[str, list[tuple[int, str]]]:
    return {c: [(f.index, f.status) for f in frames if f.camera == c] for c in {f.camera for f in frames}}


@pytest.mark.parametrize("suffix", ["png", "tif", "TIFF", "bmp"])
def test_any_prefix_and_suffix_and_start(tmp_path: Path, suffix: str) -> None:
    write_images(tmp_path / "a", [7, 8, 9, 11], f"Run2_shot{{:05d}}.{suffix}")
    write_images(tmp_path / "b", [8, 9, 10], f"{{:d}}.{suffix}", seed=100)
    frames = read(open_recording(tmp_path, fps=50))
    assert states(frames) == {
        "a": [(7, "ok"), (8, "ok"), (9, "ok"), (10, "dropped"), (11, "ok")],
        "b": [(7, "dropped"), (8, "ok"), (9, "ok"), (10, "ok"), (11, "dropped")],
    }
    assert [(f.camera, f.time_ns) for f in frames[:4]] == [("a", 0), ("b", 0), ("a", 20_000_000), ("b", 20_000_000)]
    for frame in frames:
        if frame.image is not None:
            seed = frame.index + (100 if frame.camera == "b" else 0)
            np.testing.assert_array_equal(frame.image, picture(seed))


def test_numbers_without_leading_zeros_are_in_numeric_order(tmp_path: Path) -> None:
    write_images(tmp_path / "a", list(range(8, 13)), "im{:d}.png")
    frames = read(open_recording(tmp_path, fps=10))
    assert [f.index for f in frames] == [8, 9, 10, 11, 12]
    assert frames[2].time_ns == 200_000_000


@pytest.mark.parametrize("suffix", ["png", "tif", "bmp", "jpg"])
@pytest.mark.parametrize("kept", [0, 1, 7, 20, 100, 0.3, 0.7, 0.97])
def test_truncated_files_are_corrupt_named_and_counted(tmp_path: Path, suffix: str, kept: float) -> None:
    write_images(tmp_path / "a", [0, 1, 2], f"{{:06d}}.{suffix}")
    path = tmp_path / "a" / f"000001.{suffix}"
    data = path.read_bytes()
    path.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    counts = Assembly()
    with open_recording(tmp_path, fps=100) as recording:
        sets = list(assemble(recording, recording.cameras, assembly=counts))
    assert [sorted(s.frames) for s in sets] == [["a"], [], ["a"]]
    assert counts.cameras["a"].corrupt == 1
    assert path.name in counts.notes["corrupt"]


@settings(max_examples=200, deadline=None)
@given(data=st.data(), suffix=st.sampled_from(["png", "tif", "bmp"]), deep=st.booleans())
def test_a_file_cut_anywhere_gives_no_image_or_the_whole_one(data: st.DataObject, suffix: str, deep: bool) -> None:
    image = picture(3, np.uint16 if deep and suffix != "bmp" else np.uint8)
    whole = cv2.imencode(f".{suffix}", image)[1].tobytes()
    assert what_is_missing(whole) == ""
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    found, fault = decode_image(cut)
    assert (found is None) == bool(fault)
    if found is not None:
        np.testing.assert_array_equal(found, image)


@settings(max_examples=200, deadline=None)
@given(head=st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"BM", b"II*\0", b"MM\0*"]), data=st.binary(max_size=200))
def test_any_bytes_give_an_image_or_a_fault(head: bytes, data: bytes) -> None:
    found, fault = decode_image(head + data)
    assert (found is None) == bool(fault)


def test_a_flipped_bit_in_a_png_is_noticed() -> None:
    whole = bytearray(cv2.imencode(".png", picture(1))[1].tobytes())
    whole[len(whole) // 2] ^= 4
    found, fault = decode_image(bytes(whole))
    assert found is None
    assert "wrong checksum" in fault


def test_colour_is_reduced_by_luma_and_deep_images_stay_deep(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    colour = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    colour[:, :10], colour[:, 10:20], colour[:, 20:30], colour[:, 30:] = ((255, 0, 0), (0, 255, 0), (0, 0, 255), 77)
    cv2.imwrite(str(tmp_path / "a" / "1.png"), colour)  # OpenCV writes BGR
    with_alpha = np.dstack([colour, np.full((HEIGHT, WIDTH), 9, np.uint8)])
    cv2.imwrite(str(tmp_path / "a" / "2.png"), with_alpha)
    for frame in read(open_recording(tmp_path, fps=1)):
        # BT.601 by hand: 0.114 * 255 = 29.07, 0.587 * 255 = 149.7, 0.299 * 255 = 76.2.
        assert [int(v) for v in frame.image[0, [0, 10, 20, 30]]] == [29, 150, 76, 77]
    deep = tmp_path / "deep"
    (deep / "a").mkdir(parents=True)
    cv2.imwrite(str(deep / "a" / "1.tif"), picture(5, np.uint16))
    with open_recording(deep, fps=1) as recording:
        assert recording.cameras == (CameraInfo("a", WIDTH, HEIGHT, 16, 1.0),)
        np.testing.assert_array_equal(next(iter(recording)).image, picture(5, np.uint16))


def test_rig_names_find_their_folders(tmp_path: Path) -> None:
    write_images(tmp_path / "Images_cam1", [1, 2])
    write_images(tmp_path / "cam2", [1, 2], seed=50)
    write_images(tmp_path / "old_cam2", [1, 2], seed=80)
    write_images(tmp_path / "Calibration", [1, 2, 3])
    frames = read(open_recording(tmp_path, rig_of("cam2", "cam1"), fps=10))
    assert [(f.camera, f.index) for f in frames] == [("cam2", 1), ("cam1", 1), ("cam2", 2), ("cam1", 2)]
    np.testing.assert_array_equal(frames[0].image, picture(51))
    with pytest.raises(InputError, match=r"'cam3'; there is Calibration, Images_cam1, cam2, old_cam2"):
        open_recording(tmp_path, rig_of("cam1", "cam3"), fps=10)
    write_images(tmp_path / "test_cam1", [1])
    with pytest.raises(InputError, match=r"2 entries end with the rig's camera name 'cam1'"):
        open_recording(tmp_path, rig_of("cam1"), fps=10)


def test_what_cannot_be_opened_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        open_recording(tmp_path / "none", fps=1)
    with pytest.raises(InputError, match=r"no recording in it; wanted is recording\.mcap"):
        open_recording(tmp_path, fps=1)
    write_images(tmp_path / "rec" / "a", [1, 2])
    with pytest.raises(InputError, match="pass --fps"):
        open_recording(tmp_path / "rec")
    with pytest.raises(InputError, match="--fps 0: a frame rate above 0"):
        open_recording(tmp_path / "rec", fps=0)
    with pytest.raises(InputError, match=r"40x30 px, but the rig's camera 'a' is 64x48"):
        open_recording(tmp_path / "rec", rig_of("a", size=(64, 48)), fps=1)
    with pytest.raises(InputError, match=r"numbered images lie in .* itself"):
        open_recording(tmp_path / "rec" / "a", fps=1)
    cv2.imwrite(str(tmp_path / "rec" / "a" / "01.png"), picture(1))
    with pytest.raises(InputError, match=r"'000001\.png' and '01\.png' are both number 1"):
        open_recording(tmp_path / "rec", fps=1)


def test_dates_for_numbers_and_unreadable_folders_are_said(tmp_path: Path) -> None:
    write_images(tmp_path / "rec" / "a", [1, 20240101120000])
    with pytest.raises(InputError, match="are the digits at the end of the names frame numbers"):
        open_recording(tmp_path / "rec", fps=1)
    (tmp_path / "bad" / "a").mkdir(parents=True)
    (tmp_path / "bad" / "a" / "1.png").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"none of its 1 images can be read.*neither PNG, TIFF, BMP nor JPEG"):
        open_recording(tmp_path / "bad", fps=1)


def test_an_image_of_another_size_is_corrupt(tmp_path: Path) -> None:
    write_images(tmp_path / "a", [1, 2, 3])
    cv2.imwrite(str(tmp_path / "a" / "000002.png"), picture(1, width=20))
    frames = read(open_recording(tmp_path, fps=1))
    assert [f.status for f in frames] == ["ok", "corrupt", "ok"]
    assert "20x30 px, the others are 40x30" in frames[1].note


CSV = """frame,camera,time_ns,exposure_ns,status
1,a,1000000000,2000000,ok
2,a,1010000100,2000000,ok
3,a,1020000000,,dropped
5,a,1040000000,2000000,
1,b,1000000050,2000000,corrupt
2,b,1010000000,2000000,ok
5,b,1040000000,2000000,ok
1,other,5,5,ok
"""


def test_frames_csv_gives_times_and_states(tmp_path: Path) -> None:
    write_images(tmp_path / "a", [1, 2, 5])
    write_images(tmp_path / "b", [1, 2])
    (tmp_path / "frames.csv").write_text(CSV, encoding="utf-8")
    with open_recording(tmp_path, rig_of("a", "b")) as recording:
        assert recording.cameras[0].frame_rate_hz == pytest.approx(100, rel=1e-4)
        frames = list(recording)
    assert states(frames) == {
        "a": [(1, "ok"), (2, "ok"), (3, "dropped"), (4, "dropped"), (5, "ok")],
        "b": [(1, "corrupt"), (2, "ok"), (3, "dropped"), (4, "dropped"), (5, "dropped")],
    }
    a = [f for f in frames if f.camera == "a"]
    assert [f.time_ns for f in a[:3]] == [1_000_000_000, 1_010_000_100, 1_020_000_000]
    assert a[3].time_ns == pytest.approx(1_030_000_000, abs=2000)
    assert [f.exposure_ns for f in a] == [2_000_000, 2_000_000, 0, 0, 2_000_000]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frame,camera,time_ns", "frame,camera,time", "lacks 'time_ns'; wanted is frame,camera,time_ns"),
        ("2,a,1010000100", "two,a,1010000100", "line 3: frame = 'two'; a whole number"),
        ("2,a,1010000100", "2,a,1e9", "line 3: time_ns = '1e9'"),
        ("2,a,1010000100", "2,a,1000000000", "camera 'a' do not rise from frame 1 to frame 2"),
        ("2,a,1010000100", "1,a,1010000100", "line 3: frame 1 of a stands twice"),
        (",corrupt", ",broken", "status = 'broken'; ok, dropped, corrupt are allowed"),
        (",corrupt", ",corrupt,1", "line 6: 6 values for 5 columns"),
        ("2,a,1010000100,2000000,ok\n", "", "no line for frame 2 of camera 'a', which is there"),
    ],
)
def test_faults_of_frames_csv(tmp_path: Path, old: str, new: str, message: str) -> None:
    write_images(tmp_path / "a", [1, 2, 5])
    write_images(tmp_path / "b", [1, 2])
    (tmp_path / "frames.csv").write_text(CSV.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        open_recording(tmp_path, rig_of("a", "b"))


@settings(max_examples=200, deadline=None)
@given(place=st.integers(0, len(CSV)), data=st.binary(max_size=8), length=st.integers(0, 8))
def test_any_edit_of_frames_csv_is_read_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, place: int, data: bytes, length: int
) -> None:
    path = tmp_path_factory.mktemp("csv") / "frames.csv"
    text = CSV.encode()
    path.write_bytes(text[:place] + data + text[place + length :])
    try:
        stamps = read_stamps(path, {"a": "a", "b": "b"}, None)
    except InputError:
        return
    assert stamps.rate_hz > 0


def write_video(path: Path, pulses: list[int], fmt: str = "gray", codec: str = "ffv1", rate: int = 100) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, fmt
        for pulse in pulses:
            frame = av.VideoFrame.from_ndarray(video_picture(pulse, fmt), format=fmt)
            frame.pts, frame.time_base = pulse, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def video_picture(pulse: int, fmt: str) -> np.ndarray:
    if fmt == "yuv420p":
        return np.vstack([picture(pulse), np.full((HEIGHT // 2, WIDTH), 128, np.uint8)])
    return picture(pulse, np.uint16) >> 4 if fmt == "gray12le" else picture(pulse)


@pytest.mark.parametrize("fmt", ["gray", "gray12le", "yuv420p"])
@pytest.mark.parametrize("suffix", ["mkv", "avi"])
def test_lossless_video_gives_the_stored_luma(tmp_path: Path, fmt: str, suffix: str) -> None:
    write_video(tmp_path / f"a.{suffix}", list(range(6)), fmt)
    with open_recording(tmp_path, fps=100) as recording:
        assert recording.cameras[0].bit_depth == (12 if fmt == "gray12le" else 8)
        frames = list(recording)
    assert [f.index for f in frames] == list(range(6))
    for frame in frames:
        np.testing.assert_array_equal(frame.image, video_picture(frame.index, fmt)[:HEIGHT])


@pytest.mark.parametrize("rate", [24, 60, 100, 240, 300])
def test_frames_left_out_of_a_video_shift_nothing(tmp_path: Path, rate: int) -> None:
    left_out = {5, 20, 21, 22, 60}
    write_video(tmp_path / "a.mkv", [p for p in range(100) if p not in left_out], rate=rate)
    write_video(tmp_path / "b.mkv", list(range(90)), rate=rate)
    with open_recording(tmp_path, fps=rate) as recording:
        assert recording.notes == ()
        frames = [f for f in recording if f.camera == "a"]
        ends = [f.status for f in recording if f.camera == "b"]
    assert {f.index for f in frames if f.status == "dropped"} == left_out
    np.testing.assert_array_equal(frames[99].image, picture(99))
    assert ends == ["ok"] * 90 + ["dropped"] * 10


def test_cut_and_foreign_videos(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mkv", list(range(60)))
    data = (tmp_path / "a.mkv").read_bytes()
    (tmp_path / "a.mkv").write_bytes(data[: len(data) // 2])
    with open_recording(tmp_path, fps=100) as recording:
        frames = list(recording)
        assert "cut short" in recording.notes[0]
    assert 20 < len(frames) < 40
    (tmp_path / "a.mkv").write_bytes(b"no video")
    with pytest.raises(InputError, match=r"a\.mkv: cannot be read as a video"):
        open_recording(tmp_path, fps=100)


def test_a_title_in_another_encoding_is_no_reason_not_to_read_a_video(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mkv", list(range(3)))
    path, title = tmp_path / "a.mkv", b"Lavf"
    data = path.read_bytes()
    assert title in data
    path.write_bytes(data.replace(title, b"\xff\xfeav"))
    with open_recording(tmp_path, fps=100) as recording:
        assert len(list(recording)) == 3


def test_video_without_rate_names_the_stated_one(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", list(range(5)), rate=60)
    with pytest.raises(InputError, match=r"pass --fps \(the video states 60\)"):
        open_recording(tmp_path)


def test_jpeg_sequences_are_read_as_opencv_reads_them(tmp_path: Path) -> None:
    """A thumbnail in the header has an end of its own: a file cut behind it is cut."""
    write_images(tmp_path / "rec" / "a", [3, 4, 5], "shot{:d}.JPG")
    frames = read(open_recording(tmp_path / "rec", fps=10))
    assert [f.index for f in frames] == [3, 4, 5]
    for frame in frames:
        path = tmp_path / "rec" / "a" / f"shot{frame.index}.JPG"
        np.testing.assert_array_equal(frame.image, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    colour = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    data = cv2.imencode(".jpg", colour, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    image, fault = decode_image(data)
    assert fault == ""
    assert image.shape == (HEIGHT, WIDTH)
    thumbnail = b"\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data
    with_thumbnail = data[:2] + thumbnail + data[2:]
    assert what_is_missing(with_thumbnail) == ""
    assert "cut short" in what_is_missing(with_thumbnail[:-40])
    huge = bytearray(data)
    at = huge.index(b"\xff\xc2") + 5
    huge[at : at + 4] = b"\xff\xff\xff\xff"
    assert "states 65535x65535 px" in what_is_missing(bytes(huge))


def test_videos_in_quicktime_files(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mkv", list(range(6)))
    with av.open(str(tmp_path / "a.mkv")) as source, av.open(str(tmp_path / "A.MOV"), "w", format="mov") as out:
        stream = out.add_stream("png", rate=100)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray"
        for frame in source.decode(video=0):
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    (tmp_path / "a.mkv").unlink()
    frames = read(open_recording(tmp_path, fps=100))
    assert [(f.camera, f.index) for f in frames] == [("A", k) for k in range(6)]
    for frame in frames:
        np.testing.assert_array_equal(frame.image, picture(frame.index))


def test_a_folder_for_each_camera_as_other_programs_keep_them(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / name / "calibration_images").mkdir(parents=True)
        for suffix in ("mkv", "avi"):  # one take in two containers
            write_video(tmp_path / name / "calibration_images" / f"session-{name}.{suffix}", list(range(5)))
    frames = read(open_recording(tmp_path, times_matter=False))  # a calibration needs no frame rate
    assert states(frames) == {name: [(k, "ok") for k in range(5)] for name in ("left", "right")}
    write_images(tmp_path / "left" / "again", [1])
    with pytest.raises(InputError, match=r"left: 1 folders of images and 1 videos; keep one"):
        open_recording(tmp_path, times_matter=False)
    write_video(tmp_path / "top.avi", list(range(3)))  # a video beside the folders is the camera, as ever
    assert [info.name for info in open_recording(tmp_path, fps=10).cameras] == ["top"]


@pytest.mark.data
@pytest.mark.skipif(not (DATA / "myptv_example").is_dir(), reason="needs myptv_example of MOSCA_DATA")
def test_real_image_folders() -> None:
    folder = DATA / "myptv_example" / "example"
    rig = rig_of("cam1", "cam2", "cam3", size=(1280, 1024))
    with open_recording(folder, rig, fps=100) as recording:
        frames = list(recording)
    assert [(f.camera, f.index) for f in frames] == [(f"cam{c}", n) for n in (1, 2, 3) for c in (1, 2, 3)]
    assert all(f.status == "ok" for f in frames)
    expected = cv2.imread(str(folder / "Images_cam2" / "03.tif"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(frames[7].image, expected)


@pytest.mark.data
@pytest.mark.skipif(not (DATA / "caliscope_4cam").is_dir(), reason="needs caliscope_4cam of MOSCA_DATA")
def test_real_videos() -> None:
    folder = DATA / "caliscope_4cam" / "sessions" / "4_cam_recording" / "calibration" / "extrinsic"
    with open_recording(folder, fps=6) as recording:
        assert [info.name for info in recording.cameras] == ["cam_0", "cam_1", "cam_2", "cam_3"]
        assert {(info.width, info.height) for info in recording.cameras} == {(1280, 720)}
        frames = [f for f in recording if f.camera == "cam_0"]
    with av.open(str(folder / "cam_0.mp4")) as container:
        expected = [f.to_ndarray()[:720] for f in container.decode(video=0)]
    assert len(frames) == len(expected) == 48
    for frame, pixels in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.image, pixels)
