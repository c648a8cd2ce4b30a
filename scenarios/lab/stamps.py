"""What each frame's buffer said besides the frame: arrival at this machine, the device's own stamp and counter.

A ``Frame`` carries session time. Its raw stamps are read where they pass, between driver and source: ``Tap.open``
stands in for the drivers' opener. Buffers of a camera become frames in their order, so that each frame finds its own.
"""

import weakref
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from hardware.driver import CameraDriver, Capabilities, DeviceReport, Grabbed
from hardware.drivers import open_camera
from hardware.settings import CameraHardware
from mosca.data.arrays import Array
from mosca.data.frames import Frame

OpenCamera = Callable[[str, CameraHardware], CameraDriver]


@dataclass(frozen=True)
class Stamp:
    """Arrival [ns, this machine's monotonic clock], the device's stamp [ns, its own clock] and its block number."""

    host_ns: int
    device_ns: int | None
    block_id: int | None


_Passed = tuple[Stamp, "weakref.ref[Array] | None"]


class Tap:
    """Opens drivers by ``opener`` and keeps the stamps of what they grab until ``of`` asks for them.

    ``came``: is shown each image as it comes, by the camera's own thread.
    """

    def __init__(self, opener: OpenCamera = open_camera) -> None:
        self.came: Callable[[Array], object] | None = None
        self._opener = opener
        self._passed: defaultdict[str, deque[_Passed]] = defaultdict(deque)

    def open(self, name: str, settings: CameraHardware) -> CameraDriver:
        """Open the device of camera ``name``."""
        return _Tapped(self._opener(name, settings), self._passed[name], self._grabbed)

    def _grabbed(self, image: Array) -> None:
        if self.came is not None:
            self.came(image)

    def of(self, frame: Frame) -> Stamp | None:
        """Return the stamp of ``frame``, forgetting those of buffers before it; None where none fits."""
        passed = self._passed[frame.camera]
        for place in range(len(passed)):  # the camera's thread adds to its end meanwhile
            stamp, image = passed[place]
            # without an image: a failed buffer's, or one whose pixels found no place to wait and are gone
            if (None if image is None else image()) is frame.image:
                for _ in range(place + 1):
                    passed.popleft()
                return stamp
        return None


class _Tapped:
    """A camera driver that notes what it grabs."""

    def __init__(self, driver: CameraDriver, passed: deque[_Passed], came: Callable[[Array], object]) -> None:
        self._driver, self._passed, self._came = driver, passed, came

    @property
    def capabilities(self) -> Capabilities:
        return self._driver.capabilities

    def configure(self, settings: CameraHardware) -> DeviceReport:
        return self._driver.configure(settings)

    def arm(self) -> None:
        self._driver.arm()

    def grab(self, timeout_s: float) -> Grabbed | None:
        buffer = self._driver.grab(timeout_s)
        if buffer is not None:
            image = None if buffer.image is None else weakref.ref(buffer.image)
            self._passed.append((Stamp(buffer.host_ns, buffer.device_ns, buffer.block_id), image))
            if buffer.image is not None:
                self._came(buffer.image)
        return buffer

    def software_trigger(self) -> int:
        return self._driver.software_trigger()

    def disarm(self) -> None:
        self._driver.disarm()

    def statistics(self) -> Mapping[str, int]:
        return self._driver.statistics()

    def close(self) -> None:
        self._driver.close()
