"""What every FrameSource keeps, whatever it is made of.

To add a source: write a function ``(folder) -> FrameSource`` that gives two cameras ``a`` and ``b`` of 64x48 px
at 100 frames/s, eight pulses, with at least one frame lost, and put it into ``SOURCES``; into ``LIVE`` too where it
can be iterated once only, and a second take needs another source.
"""

import os
import sys
import threading
from collections.abc import Callable, Iterator
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))
from fake_rig import Fake, FakeDriver, FakeLine, write_rig

from hardware.driver import DeviceError
from hardware.settings import read_hardware
from hardware.source import HardwareSource
from mosca.data.frames import CameraInfo, Frame, FrameSource, mid_exposure_ns
from mosca.data.rig import Camera, MoscaLens, Pose
from mosca.recording import RecordingWriter, open_recording
from mosca.synchronisation import Assembly, assemble
from twin.cameras.delivery import Delivery
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.cloud import build_cloud
from twin.source import TwinSource

PULSES, RATE_HZ, WIDTH, HEIGHT = 8, 100.0, 64, 48
LOST = ("b", 3)
Factory = Callable[[Path], FrameSource]


def picture(camera: str, pulse: int) -> np.ndarray:
    image = np.random.default_rng([ord(camera), pulse]).integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8)
    image[0, 0] = pulse
    return image


def folder_source(folder: Path) -> FrameSource:
    for camera in "ab":
        (folder / camera).mkdir(parents=True)
        for pulse in range(PULSES):
            if (camera, pulse) != LOST:
                cv2.imwrite(str(folder / camera / f"shot{pulse + 5:04d}.png"), picture(camera, pulse))
    return open_recording(folder, fps=RATE_HZ)


def video_source(folder: Path) -> FrameSource:
    folder.mkdir()
    for camera in "ab":
        with av.open(str(folder / f"{camera}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=int(RATE_HZ))
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray"
            for pulse in range(PULSES):
                if (camera, pulse) == LOST:
                    continue
                frame = av.VideoFrame.from_ndarray(picture(camera, pulse), format="gray")
                frame.pts, frame.time_base = pulse, Fraction(1, int(RATE_HZ))
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    return open_recording(folder, fps=RATE_HZ)


def mcap_source(folder: Path) -> FrameSource:
    cameras = [CameraInfo(name, WIDTH, HEIGHT, 8, RATE_HZ) for name in "ab"]
    with RecordingWriter(folder, cameras) as writer:
        for pulse in range(PULSES):
            for camera in "ab":
                if (camera, pulse) != LOST:
                    writer.write(Frame(camera, pulse, pulse * 10_000_000, 500_000, picture(camera, pulse)))
    return open_recording(folder)


def twin_source(folder: Path) -> FrameSource:
    scene = build_cloud(
        duration_s=1.0, box_center_m=np.zeros(3), box_size_m=np.ones(3), rng=np.random.default_rng(0), n=3
    )
    lens = MoscaLens(1.5, 31.0, 23.0, 0.02, 0.02)
    looking = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    cameras = tuple(
        VirtualCamera(Camera(name, WIDTH, HEIGHT, lens, Pose(looking, np.array([-3.0, y, 0.0]))))
        for name, y in (("a", 0.0), ("b", 0.5))
    )
    name, number = LOST
    dead = Delivery(dies_s=(number - 0.5) / RATE_HZ, returns_s=(number + 0.5) / RATE_HZ)
    return TwinSource(
        scene,
        cameras,
        frame_rate_hz=RATE_HZ,
        exposure_s=5e-4,
        pulses=PULSES,
        seed=1,
        workers=2,
        deliveries={name: dead},
    )


def rig_source(folder: Path) -> FrameSource:
    folder.mkdir()
    rig = read_hardware(write_rig(folder / "rig.toml", "ab", (WIDTH, HEIGHT), RATE_HZ))
    camera, pulse = LOST
    line = FakeLine(RATE_HZ)
    fakes = {name: Fake(readable=True, picture=picture) for name in "ab"}
    fakes[camera].spoilt = frozenset({pulse})
    return HardwareSource(
        rig,
        PULSES,
        lambda name, settings: FakeDriver(name, settings, fakes[name], line, (WIDTH, HEIGHT)),
        lambda rig, drivers: line,
    )


LIVE = ("rig",)


SOURCES: dict[str, Factory] = {
    "folder": folder_source, "video": video_source, "mcap": mcap_source, "twin": twin_source, "rig": rig_source,
}  # fmt: skip
"""Every source under contract."""


@pytest.fixture(params=list(SOURCES))
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def source(kind: str, tmp_path: Path) -> Iterator[FrameSource]:
    made = SOURCES[kind](tmp_path / "recording")
    yield made
    made.close()


@pytest.fixture
def again(kind: str, source: FrameSource, tmp_path: Path) -> Iterator[FrameSource]:
    """What gives the frames of ``source`` once more: itself, or of a live one another take."""
    made = SOURCES[kind](tmp_path / "again") if kind in LIVE else source
    yield made
    made.close()


def by_camera(frames: list[Frame]) -> dict[str, list[Frame]]:
    return {camera: [frame for frame in frames if frame.camera == camera] for camera in "ab"}


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_it_is_a_frame_source(source: FrameSource) -> None:
    assert isinstance(source, FrameSource)
    assert [info.name for info in source.cameras] == ["a", "b"]


def test_indices_and_times_rise_per_camera(source: FrameSource) -> None:
    for frames in by_camera(list(source)).values():
        assert all(a.index < b.index for a, b in pairwise(frames))
        assert all(a.time_ns < b.time_ns for a, b in pairwise(frames))


def test_images_are_read_only_and_of_the_stated_size(source: FrameSource) -> None:
    infos = {info.name: info for info in source.cameras}
    usable = [frame for frame in source if frame.status == "ok"]
    assert len(usable) >= 2 * PULSES - 4
    for frame in usable:
        info = infos[frame.camera]
        assert frame.image.shape == (info.height, info.width)
        assert frame.image.dtype == (np.uint8 if info.bit_depth <= 8 else np.uint16)
        with pytest.raises(ValueError, match="read-only"):
            frame.image[0, 0] = 1


def test_a_lost_frame_is_a_gap_not_a_shift(source: FrameSource, again: FrameSource) -> None:
    frames = list(source)
    first = min(frame.index for frame in frames)
    seen = {(f.camera, f.index - first): f for f in frames if f.status == "ok"}
    assert len(seen) < 2 * PULSES
    for (_, pulse), frame in seen.items():
        assert abs(mid_exposure_ns(frame) - pulse * 1e9 / RATE_HZ) < 0.2e9 / RATE_HZ
    counts = Assembly()
    sets = list(assemble(again, again.cameras, assembly=counts))
    assert [s.pulse for s in sets] == list(range(PULSES))
    for frame_set in sets:
        for camera, frame in frame_set.frames.items():
            assert frame.index - first == frame_set.pulse
            assert (camera, frame_set.pulse) in seen
    lost = sum(c.dropped + c.corrupt for c in counts.cameras.values())
    assert lost == 2 * PULSES - len(seen)


def test_the_same_bytes_twice(source: FrameSource, again: FrameSource) -> None:
    def contents(frames: FrameSource) -> list[tuple]:
        return [
            (f.camera, f.index, f.time_ns, f.exposure_ns, f.status, f.image is not None and f.image.tobytes())
            for f in frames
        ]

    found = contents(source)
    assert len({one[:2] for one in found}) == len(found) > 0
    assert sorted(found) == sorted(contents(again)) if source is not again else found == contents(again)


def test_leaving_early_frees_everything(source: FrameSource, again: FrameSource) -> None:
    before = open_files(), threading.active_count()
    for frame in source:
        assert frame.camera in "ab"
        break
    iteration = iter(again)
    next(iteration)
    for one in (source, again):
        one.close()
        one.close()
    assert (open_files(), threading.active_count()) == before


@pytest.mark.parametrize("name", LIVE)
def test_a_live_source_refuses_a_second_iteration(name: str, tmp_path: Path) -> None:
    with SOURCES[name](tmp_path / "recording") as source:
        for _ in source:
            break
        with pytest.raises(DeviceError, match="open it again for another take"):
            next(iter(source))


def test_it_closes_on_an_error(source: FrameSource) -> None:
    before = open_files()

    def fail() -> None:
        with source as entered:
            for _ in entered:
                raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert open_files() == before


@pytest.mark.parametrize("name", ["folder", "video", "mcap"])
def test_recordings_give_the_very_pixels(name: str, tmp_path: Path) -> None:
    with SOURCES[name](tmp_path / "recording") as source:
        first = min(frame.index for frame in source)
        frames = [f for f in source if f.status == "ok"]
    assert len(frames) == 2 * PULSES - 1
    for frame in frames:
        np.testing.assert_array_equal(frame.image, picture(frame.camera, frame.index - first))
