"""Base of all drivers: states and locks of an open camera, and the text of its errors."""

import contextlib
import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

from hardware.driver import Capabilities, ClockReading, Device, DeviceError, DeviceReport, Grabbed
from hardware.drivers.configure import capabilities_of, configure, exposure_ns, latch_of, model_and_serial
from hardware.drivers.features import FeatureRefused, Features
from hardware.drivers.pixels import FORMATS
from hardware.settings import CameraHardware

log = logging.getLogger("mosca.hardware.drivers")

# a waiting grab releases the lock to other threads at this interval
SLICE_S = 0.05

_claimed: dict[tuple[str, str], str] = {}
_claiming = threading.Lock()


def claim(device: Device, camera: str) -> None:
    """Reserve a device for ``camera``; DeviceError where this program has it open already.

    Not every library refuses a second opening, and two grabbers would share the frames between them.
    """
    key = (device.driver, device.address or device.serial)
    with _claiming:
        if key in _claimed:
            raise DeviceError(
                f"camera '{camera}': {described(device)} is open already as camera '{_claimed[key]}'; "
                "close that first, or name another serial"
            )
        _claimed[key] = camera


def release(device: Device) -> None:
    """Give a claimed device back."""
    with _claiming:
        _claimed.pop((device.driver, device.address or device.serial), None)


def chosen(found: Sequence[Device], settings: CameraHardware) -> Device | None:
    """Return the first device that ``serial`` and ``address`` name, None where there is none."""
    for device in found:
        if settings.serial in ("", device.serial) and settings.address in ("", device.address):
            return device
    return None


def not_found(found: Sequence[Device], name: str, settings: CameraHardware) -> DeviceError:
    """Return the error that names the missing device and those that are there."""
    wanted = " and ".join(
        f"{key} '{value}'" for key, value in (("serial", settings.serial), ("address", settings.address)) if value
    )
    there = "; ".join(described(device) for device in found) or "none"
    return DeviceError(
        f"camera '{name}': driver '{settings.driver}' sees no device with {wanted}; check power, cable and "
        f"network. There are: {there}"
    )


def described(device: Device) -> str:
    """Return a device in a few words."""
    at = f" at {device.address}" if device.address and device.address != device.serial else ""
    return f"{device.model} {device.serial}".strip() + at


class OpenCamera(ABC):
    """One open camera. ``grab`` belongs to one thread; ``software_trigger``, ``clock`` and ``close`` to any.

    Two locks: access to the device's registers holds ``_control``, access to its stream ``_stream``; ``_control`` is
    taken first where both are needed. A waiting grab releases the stream every 50 ms.
    """

    def __init__(self, name: str, device: Device) -> None:
        """``device``: claimed by the caller."""
        self.name = name
        self.device = device
        self._control = threading.RLock()
        self._stream = threading.RLock()
        self._armed = False
        self._open = True
        self._leaving = False
        self._trigger = ""
        self._exposure_ns = 0

    @property
    @abstractmethod
    def capabilities(self) -> Capabilities:
        """What this device can do."""

    def configure(self, settings: CameraHardware) -> DeviceReport:
        """Set the device and read it back; DeviceError where it accepted another value than the one requested."""
        with self._control:
            self._demand_open()
            if self._armed:
                raise self._error("is armed; disarm it before it is set")
            report = self._configure(settings)
            self._trigger, self._exposure_ns = settings.trigger, report.exposure_ns
            return report

    def arm(self) -> None:
        """Begin to wait for triggers, or to run free; does nothing while armed."""
        with self._control:
            self._demand_open()
            if not self._armed:
                with self._stream:
                    self._start()
                    self._leaving = False
                    self._armed = True
                log.debug("camera '%s': armed", self.name)

    def grab(self, timeout_s: float) -> Grabbed | None:
        """Return the next buffer, failed ones too, or None when none came within ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while True:
            with self._stream:
                self._demand_open()
                if not self._armed:
                    raise self._error("is not armed; nothing can be grabbed")
                grabbed = self._fetch(max(0.0, min(SLICE_S, deadline - time.monotonic())))
            if grabbed is not None:
                return grabbed
            if self._leaving or time.monotonic() >= deadline:
                return None

    def software_trigger(self) -> int:
        """Fire one exposure; return this machine's monotonic time [ns] half-way through the command."""
        with self._control:
            self._demand_open()
            if not self.capabilities.software_trigger:
                raise self._error("cannot be triggered by software")
            if self._trigger != "Software" or not self._armed:
                raise self._error(
                    f"is not waiting for software triggers (trigger = '{self._trigger}', "
                    f"{'armed' if self._armed else 'not armed'}); set trigger = 'Software' and arm it"
                )
            self._await_ready()
            before = time.monotonic_ns()
            self._fire()
            return (before + time.monotonic_ns()) // 2

    def clock(self) -> ClockReading | None:
        """Return the camera's clock now; None where it cannot be latched."""
        with self._control:
            return self._read_clock() if self._open else None

    def disarm(self) -> None:
        """Stop; buffers that are still being transferred are dropped."""
        with self._control:
            self._leaving = True
            with self._stream:
                if self._armed:
                    self._armed = False
                    self._stop()

    def statistics(self) -> Mapping[str, int]:
        """Return the driver's own counts since ``arm``, by its names; empty before it."""
        with self._control, self._stream:
            return self._counts() if self._open else {}

    def close(self) -> None:
        """Free the device; may be called twice."""
        with self._control:
            if not self._open:
                return
            self._leaving = True
            with self._stream:
                try:
                    if self._armed:
                        self._armed = False
                        # a camera that is gone cannot be stopped, and is freed all the same
                        with contextlib.suppress(DeviceError):
                            self._stop()
                finally:
                    self._open = False
                    release(self.device)
                    self._free()
                    log.info("camera '%s': closed", self.name)

    def _demand_open(self) -> None:
        if not self._open:
            raise self._error("is closed; open it again")

    def _error(self, text: str) -> DeviceError:
        return DeviceError(f"camera '{self.name}' ({described(self.device)}): {text}")

    def _gone(self, why: str) -> DeviceError:
        return self._error(f"stopped answering ({why}); check its power and cable, then open it again")

    @abstractmethod
    def _configure(self, settings: CameraHardware) -> DeviceReport: ...

    @abstractmethod
    def _start(self) -> None: ...

    @abstractmethod
    def _stop(self) -> None: ...

    @abstractmethod
    def _fetch(self, timeout_s: float) -> Grabbed | None:
        """Return a buffer that comes within ``timeout_s``; DeviceError where the device is gone."""

    @abstractmethod
    def _counts(self) -> Mapping[str, int]: ...

    @abstractmethod
    def _free(self) -> None: ...

    def _await_ready(self) -> None:  # noqa: B027 - most devices do not signal when they are ready
        """Wait until a trigger would be taken."""

    def _fire(self) -> None:
        raise NotImplementedError

    def _read_clock(self) -> ClockReading | None:
        return None


class GenICamCamera(OpenCamera):
    """An open camera that is set by its feature tree."""

    features: Features

    def __init__(self, name: str, device: Device, features: Features) -> None:
        super().__init__(name, device)
        self.features = features
        self._latch: tuple[str, str, int] | None = None
        try:
            self._capabilities = self._asked()
        except FeatureRefused as error:
            raise self._gone(str(error)) from None

    @property
    def capabilities(self) -> Capabilities:
        """What this device can do, by its feature tree."""
        return self._capabilities

    def _configure(self, settings: CameraHardware) -> DeviceReport:
        try:
            return self._configured(settings)
        except FeatureRefused as error:
            # refused settings are reported by name: this device does not even list its features
            raise self._gone(str(error)) from None

    def _configured(self, settings: CameraHardware) -> DeviceReport:
        taken = configure(self.features, settings, self.name)
        # the possible rates and windows depend on the settings
        self._capabilities = self._asked()
        self._latch = latch_of(self.features) if self._capabilities.device_clock else None
        model, serial = model_and_serial(self.features)
        return DeviceReport(
            model=model or self.device.model,
            serial=self.device.serial or serial,
            width=int(self.features.read("Width")),
            height=int(self.features.read("Height")),
            bit_depth=FORMATS[settings.pixel_format].bits,
            exposure_ns=exposure_ns(self.features, settings),
            settings=taken,
        )

    def _asked(self) -> Capabilities:
        return capabilities_of(self.features)

    def _fire(self) -> None:
        try:
            self.features.execute("TriggerSoftware")
        except FeatureRefused as error:
            raise self._error(f"did not take the software trigger ({error})") from None

    def _read_clock(self) -> ClockReading | None:
        if self._latch is None:
            return None
        command, value, ticks_hz = self._latch
        try:
            before = time.monotonic_ns()
            self.features.execute(command)
            after = time.monotonic_ns()
            shown = self.features.read(value)
        except FeatureRefused as error:
            raise self._error(f"does not tell its clock ({error})") from None
        return ClockReading(int(shown) * 10**9 // ticks_hz, before, after)
