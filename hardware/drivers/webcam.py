"""Webcams, or video files as cameras, through OpenCV's VideoCapture.

A webcam is free-running and has no readable clock: its frames carry host time stamps, so frame sets of several
webcams are as precise as their arrival times. A file is played from its beginning, as fast as it is grabbed; after
its last frame no more frames come. Lossless grey files (FFV1, pix_fmt gray) are reproduced bit for bit.
"""

import contextlib
import queue
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from hardware.driver import Capabilities, Device, DeviceError, DeviceReport, Grabbed
from hardware.drivers.opened import OpenCamera, chosen, claim, not_found, release
from hardware.drivers.pixels import luma
from hardware.settings import CameraHardware
from mosca.data.arrays import Array

QUEUED = 8
# V4L2 through OpenCV: exposure in units of 100 us, automatic exposure off is 1
EXPOSURE_STEP_US, MANUAL_EXPOSURE = 100.0, 1.0
VIDEO_CLASS = Path("/sys/class/video4linux")


def load() -> ModuleType:
    """Import OpenCV; ImportError where it is not installed."""
    import cv2

    module: ModuleType = cv2
    return module


def devices(producer: str = "") -> Sequence[Device]:
    """Return the video devices that Linux lists; elsewhere none are listed, and address is a number from 0."""
    load()
    found = []
    for folder in sorted(VIDEO_CLASS.glob("video*")) if VIDEO_CLASS.is_dir() else []:
        name = (folder / "name").read_text(encoding="utf-8", errors="replace").strip()
        found.append(Device("webcam", name, "", folder.name.removeprefix("video")))
    return found


def open_camera(name: str, settings: CameraHardware) -> "Webcam":
    """Open the device number, or the video file, given by ``address``."""
    cv2 = load()
    if settings.serial:
        raise DeviceError(
            f"camera '{name}': a webcam has no serial that can be asked for ('{settings.serial}'); "
            "name its number or a video file as address"
        )
    numbered = settings.address.isdecimal()
    if numbered:
        found = devices()
        device = chosen(found, settings)
        if device is None and sys.platform == "linux":
            raise not_found(found, name, settings)
        device = device or Device("webcam", "webcam", "", settings.address)
    else:
        path = Path(settings.address)
        if not path.is_file():
            raise DeviceError(f"camera '{name}': no video file at {path}; address is a device's number or a file")
        device = Device("webcam", "video file", "", str(path.resolve()))
    claim(device, name)
    try:
        return Webcam(cv2, name, device, int(settings.address) if numbered else None)
    except BaseException:
        release(device)
        raise


class Webcam(OpenCamera):
    """One webcam or video file. A thread reads it, because OpenCV's grab has no time-out.

    Where the receiver is slower than a webcam, frames are lost and counted (``overruns``), and ``block_id`` has
    gaps; a file waits.
    """

    def __init__(self, cv2: ModuleType, name: str, device: Device, number: int | None) -> None:
        super().__init__(name, device)
        self._cv2, self._number = cv2, number
        self._capture: Any = self._opened()
        self._reader: _Reader | None = None

    @property
    def capabilities(self) -> Capabilities:
        """No capability but to run free."""
        return Capabilities(stamp_event="readout", real_time=self._number is not None)

    def _opened(self) -> Any:
        source = str(self.device.address) if self._number is None else self._number
        capture = self._cv2.VideoCapture(source)
        if not capture.isOpened():
            raise self._error(
                "does not open; "
                + ("is it a video that OpenCV can read?" if self._number is None else "does another program have it?")
            )
        return capture

    def _configure(self, settings: CameraHardware) -> DeviceReport:
        self._refuse_what_it_cannot(settings)
        cv2 = self._cv2
        taken: dict[str, object] = {}
        if settings.window is not None:
            left, top, width, height = settings.window
            if left or top:
                raise self._error(f"window = {list(settings.window)}: a webcam has no offsets; allowed: [0, 0, W, H]")
            taken["CAP_PROP_FRAME_WIDTH"] = self._set("CAP_PROP_FRAME_WIDTH", width, "window")
            taken["CAP_PROP_FRAME_HEIGHT"] = self._set("CAP_PROP_FRAME_HEIGHT", height, "window")
        if settings.exposure_us is not None:
            self._set("CAP_PROP_AUTO_EXPOSURE", MANUAL_EXPOSURE, "exposure_us")
            steps = settings.exposure_us / EXPOSURE_STEP_US
            taken["CAP_PROP_EXPOSURE"] = self._set("CAP_PROP_EXPOSURE", steps, "exposure_us")
        if settings.gain_db is not None:
            taken["CAP_PROP_GAIN"] = self._set("CAP_PROP_GAIN", settings.gain_db, "gain_db")
        for name, value in settings.features.items():
            if isinstance(value, str):
                raise self._error(f"{name} = '{value}': OpenCV's properties are numbers")
            taken[name] = self._set(name, float(value), "features")
        taken["CAP_PROP_FPS"] = self._capture.get(cv2.CAP_PROP_FPS)
        taken["backend"] = self._capture.getBackendName()
        return DeviceReport(
            model=self.device.model,
            serial=self.device.serial,
            width=int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            height=int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
            bit_depth=8,
            exposure_ns=round((settings.exposure_us or 0.0) * 1000.0),
            settings=taken,
        )

    def _refuse_what_it_cannot(self, settings: CameraHardware) -> None:
        if settings.trigger != "Off":
            raise self._error(f"trigger = '{settings.trigger}': a webcam runs free; allowed: Off")
        if settings.pixel_format != "Mono8":
            raise self._error(f"pixel_format = '{settings.pixel_format}': a webcam gives Mono8; allowed: Mono8")
        if settings.packet_bytes is not None:
            raise self._error(f"packet_bytes = {settings.packet_bytes}: a webcam has no packets; leave it out")

    def _set(self, name: str, value: float, key: str) -> float:
        number = getattr(self._cv2, name, None) if name.startswith("CAP_PROP_") else None
        if not isinstance(number, int):
            raise self._error(f"the device has no feature '{name}'; features are OpenCV's CAP_PROP_ names")
        before = float(self._capture.get(number))
        if before == value:
            return before
        self._capture.set(number, value)
        taken = float(self._capture.get(number))
        if abs(taken - value) > 0.005 * abs(value):
            raise self._error(
                f"{name} ({key}) = {value:.10g} asked for, the device took {taken:.10g}; "
                "leave it out, or name a value that it takes"
            )
        return taken

    def _start(self) -> None:
        if self._number is None:
            # each time from the beginning
            self._capture.release()
            self._capture = self._opened()
        self._reader = _Reader(self._capture, waits=self._number is None)

    def _fetch(self, timeout_s: float) -> Grabbed | None:
        reader = self._reader
        if reader is None:
            return None
        try:
            number, host_ns, picture = reader.frames.get(timeout=max(timeout_s, 1e-3))
        except queue.Empty:
            if reader.ended.is_set() and reader.frames.empty() and self._number is not None:
                raise self._gone("OpenCV reads no more frames") from None
            return None
        image, note = _mono(picture)
        return Grabbed(number, None, host_ns, self._exposure_ns, image, note)

    def _stop(self) -> None:
        if self._reader is not None:
            self._reader.stop()

    def _counts(self) -> Mapping[str, int]:
        reader = self._reader
        return {} if reader is None else {"frames": reader.count, "overruns": reader.overruns}

    def _free(self) -> None:
        self._capture.release()


class _Reader:
    """Reads a capture into a short queue until it is stopped or the capture ends."""

    def __init__(self, capture: Any, waits: bool) -> None:
        self.frames: queue.Queue[tuple[int, int, Array]] = queue.Queue(QUEUED)
        self.ended = threading.Event()
        self.count = self.overruns = 0
        self._capture, self._waits = capture, waits
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._read, name="webcam", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop reading; returns when the thread is gone."""
        self._stopping.set()
        self._thread.join()

    def _read(self) -> None:
        while not self._stopping.is_set():
            there, picture = self._capture.read()
            if not there:
                break
            self.count += 1
            self._hand_over((self.count, time.monotonic_ns(), picture))
        self.ended.set()

    def _hand_over(self, frame: tuple[int, int, Array]) -> None:
        while not self._stopping.is_set():
            try:
                self.frames.put(frame, timeout=0.05)
                return
            except queue.Full:
                if not self._waits:
                    # drop the oldest frame, keep the newest
                    with contextlib.suppress(queue.Empty):
                        self.frames.get_nowait()
                        self.overruns += 1


def _mono(picture: Array) -> tuple[Array | None, str]:
    """Return OpenCV's picture as (H, W) uint8 in memory of its own and "", or None and the reason."""
    if picture.dtype == np.uint8 and picture.ndim == 2:
        return np.ascontiguousarray(picture), ""
    if picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3:
        # OpenCV makes everything blue, green, red; grey stays what it was, because the weights add up to one
        blue, green, red = (picture[:, :, channel] for channel in range(3))
        return luma(red, green, blue), ""
    return None, f"PIXEL_FORMAT_UNKNOWN {picture.dtype} {picture.shape}"
