"""Devices for the drivers' tests: one of each driver, opened by the settings that it gives."""

import contextlib
import fcntl
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from needs import needs_aravis, needs_module

from hardware.driver import CameraDriver, DeviceError
from hardware.drivers import gige
from hardware.settings import CameraHardware
from mosca.data.arrays import Array

# read at pylon's first enumeration
os.environ.setdefault("PYLON_CAMEMU", "4")

WIDTH, HEIGHT = 160, 120
FAKE_ADDRESS = "127.0.0.1"


@dataclass(frozen=True)
class Driven:
    """``free``: settings that run; ``silent``: settings under which no frame comes; ``wrong``: a refused value."""

    driver: str
    free: CameraHardware
    silent: CameraHardware
    wrong: dict[str, Any]
    producer: str = ""
    frames: int = 4
    extra: dict[str, Any] = field(default_factory=dict)

    def with_(self, **changes: Any) -> CameraHardware:
        """Return the free-running settings with changes."""
        return CameraHardware(**{**self.free.model_dump(), **changes})


def grab_for(camera: CameraDriver, seconds: float) -> None:
    """Grab, whatever comes, for so long."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        camera.grab(0.2)


def one_line(error: BaseException, *words: str) -> None:
    """Assert that an error is one line that holds ``words``."""
    text = str(error)
    assert "\n" not in text
    for word in words:
        assert word in text, f"'{word}' is not in: {text}"


@contextlib.contextmanager
def refused(*words: str) -> Iterator[None]:
    """Assert that the block raises a DeviceError of one line that holds ``words``."""
    with pytest.raises(DeviceError) as caught:
        yield
    one_line(caught.value, *words)


def wait_long_for_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may hold a sender up in the midst of a frame for longer than cameras ever are."""
    patient = {"frame-retention": ("uint", 20_000_000), "packet-timeout": ("uint", 300_000)}
    kept = [one for one in gige.STREAM_PROPERTIES if one[0] not in patient]
    kept += [(name, kind, value) for name, (kind, value) in patient.items()]
    monkeypatch.setattr(gige, "STREAM_PROPERTIES", tuple(kept))


def pictures(count: int, seed: int, width: int = 656, height: int = 491) -> list[Array]:
    """Return ``count`` pictures that differ in every pixel."""
    rng = np.random.default_rng(seed)
    return [rng.integers(0, 256, (height, width), dtype=np.uint8) for _ in range(count)]


def write_video(path: Path, images: list[Array]) -> None:
    """Write a lossless grey video: FFV1 with pix_fmt gray."""
    import av

    with av.open(str(path), "w") as out:
        stream = out.add_stream("ffv1", rate=100)
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = "gray"
        for image in images:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        out.mux(stream.encode())


@contextlib.contextmanager
def gige_driven(tmp_path: Path) -> Iterator[Driven]:
    """Aravis' own fake camera, in a process of its own."""
    with fake_gige_camera("FAKE1") as settings:
        yield Driven(
            "gige", free=settings(trigger="Off"), silent=settings(trigger="Software"), wrong={"exposure_us": 1e9}
        )


@contextlib.contextmanager
def pylon_driven(tmp_path: Path) -> Iterator[Driven]:
    """One of pylon's emulated cameras."""
    needs_module("pypylon.pylon", "pylon")

    def settings(**more: Any) -> CameraHardware:
        return CameraHardware(driver="pylon", serial="0815-0000", window=(0, 0, WIDTH, HEIGHT), **more)

    yield Driven(
        "pylon", free=settings(trigger="Off"), silent=settings(trigger="Software"), wrong={"exposure_us": 1e9}
    )


@contextlib.contextmanager
def gentl_driven(tmp_path: Path) -> Iterator[Driven]:
    """One of the software cameras of the producer that the genicam wheel ships."""
    needs_module("harvesters.core", "gentl")
    producer = viky()

    def settings(rate_hz: float) -> CameraHardware:
        return CameraHardware(
            driver="gentl",
            serial="1",
            producer=producer,
            trigger="Off",
            window=(0, 0, WIDTH, HEIGHT),
            features={"AcquisitionFrameRate": rate_hz},
        )

    yield Driven(
        "gentl", free=settings(100.0), silent=settings(1.0), wrong={"window": (0, 0, 100000, 100)}, producer=producer
    )


@contextlib.contextmanager
def webcam_driven(tmp_path: Path) -> Iterator[Driven]:
    """A video file instead of a webcam; no frames come after its end."""
    path = tmp_path / "webcam.mkv"
    write_video(path, pictures(6, 7, WIDTH, HEIGHT))
    settings = CameraHardware(driver="webcam", address=str(path), trigger="Off")
    yield Driven("webcam", free=settings, silent=settings, wrong={"window": (0, 0, 100000, 100)})


DRIVEN: dict[str, Callable[[Path], contextlib.AbstractContextManager[Driven]]] = {
    "gige": gige_driven,
    "pylon": pylon_driven,
    "gentl": gentl_driven,
    "webcam": webcam_driven,
}


def viky() -> str:
    """Return the path of the software GenTL producer."""
    genicam = needs_module("genicam", "gentl")
    return str(Path(str(genicam.__file__)).parent / "viky.cti")


@contextlib.contextmanager
def fake_gige_camera(serial: str, lost_permille: float = 0.0) -> Iterator[Callable[..., CameraHardware]]:
    """Run the fake camera; yield what makes settings for it, with ``end`` to pull its plug.

    It needs an address that an interface has, and there is one: other workers wait for theirs.
    """
    needs_aravis()
    with open(Path(tempfile.gettempdir()) / "mosca_fake_gige_camera.lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        process = subprocess.Popen(
            [
                sys.executable,
                str(Path(__file__).with_name("fake_gige_camera.py")),
                FAKE_ADDRESS,
                serial,
                str(lost_permille),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        assert process.stdin is not None

        def settings(**more: Any) -> CameraHardware:
            kept = {"serial": serial, "window": (0, 0, WIDTH, HEIGHT), **more}
            return CameraHardware(driver="gige", **kept)

        def end() -> None:
            process.kill()
            process.wait()

        settings.end = end  # type: ignore[attr-defined]
        try:
            assert process.stdout.readline().strip() == "serving"
            yield settings
        finally:
            end()
            process.stdin.close()
            process.stdout.close()
