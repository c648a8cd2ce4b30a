"""Basler cameras of any interface, through pylon (pypylon), and pylon's camera emulator.

The environment variable PYLON_CAMEMU is the number of emulated cameras. They show test images or files,
can only be triggered by software, silently ignore triggers that come too early, and have no clock.
"""

import time
import warnings
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np

from hardware.driver import Capabilities, Device, DeviceError, DeviceReport, Grabbed
from hardware.drivers.blocks import BlockIds
from hardware.drivers.configure import capabilities_of
from hardware.drivers.features import FeatureRefused, Kind, number
from hardware.drivers.gentl_features import first_line
from hardware.drivers.opened import GenICamCamera, chosen, claim, described, not_found, release
from hardware.drivers.pixels import whole_image
from hardware.settings import CameraHardware, Feature

EMULATED = "BaslerCamEmu"
BUFFERS = 32
# an exposure and its readout are over by then, or something is wrong
READY_MS, READY_LOOKS = 5000, 50
STATISTICS = "Statistic_"


def load() -> ModuleType:
    """Import pypylon; ImportError where it is not installed."""
    with warnings.catch_warnings():
        # the wrapped classes have no __module__, which newer Pythons mind
        warnings.simplefilter("ignore", DeprecationWarning)
        from pypylon import pylon

    module: ModuleType = pylon
    return module


def devices(producer: str = "") -> Sequence[Device]:
    """Return the Basler cameras on all interfaces, emulated ones too."""
    return [_device(info) for info in load().TlFactory.GetInstance().EnumerateDevices()]


def open_camera(name: str, settings: CameraHardware) -> "PylonCamera":
    """Open the camera with the serial number, or at the IP address, of ``settings``."""
    pylon = load()
    factory = pylon.TlFactory.GetInstance()
    infos = factory.EnumerateDevices()
    found = [_device(info) for info in infos]
    device = chosen(found, settings)
    if device is None:
        raise not_found(found, name, settings)
    claim(device, name)
    try:
        info = infos[found.index(device)]
        camera = pylon.InstantCamera(factory.CreateDevice(info))
        return PylonCamera(pylon, name, device, camera, info.GetDeviceClass() == EMULATED)
    except BaseException as error:
        release(device)
        if isinstance(error, _pylon_error(pylon)):
            raise DeviceError(
                f"camera '{name}': {described(device)} does not open ({first_line(error)}); "
                "does another program have it?"
            ) from None
        raise


def _device(info: Any) -> Device:
    address = info.GetIpAddress() if info.IsIpAddressAvailable() else info.GetSerialNumber()
    return Device("pylon", info.GetModelName(), info.GetSerialNumber(), address)


def _pylon_error(pylon: ModuleType) -> type[Exception]:
    error: type[Exception] = pylon.GenericException
    return error


class PylonFeatures:
    """The feature tree of an open InstantCamera."""

    def __init__(self, pylon: ModuleType, camera: Any) -> None:
        from pypylon import genicam

        self._genicam: Any = genicam
        self._error = _pylon_error(pylon)
        self._map = camera.GetNodeMap()
        self._kinds: dict[int, Kind] = {
            genicam.intfIInteger: "integer",
            genicam.intfIFloat: "float",
            genicam.intfIBoolean: "boolean",
            genicam.intfIEnumeration: "enumeration",
            genicam.intfIString: "string",
            genicam.intfICommand: "command",
        }

    def names(self) -> Sequence[str]:
        """Return the names of all features."""
        nodes = [node.GetNode() for node in self._map.GetNodes()]
        return sorted(node.GetName() for node in nodes if node.IsFeature())

    def kind(self, name: str) -> Kind | None:
        """Return what sort of feature it is, None where there is none of that name just now."""
        node = self._map.GetNode(name)
        if node is None or not self._genicam.IsAvailable(node):
            return None
        return self._kinds.get(node.GetNode().GetPrincipalInterfaceType())

    def writable(self, name: str) -> bool:
        """Whether it can be written just now."""
        return bool(self._genicam.IsWritable(self._map.GetNode(name)))

    def readable(self, name: str) -> bool:
        """Whether it can be read just now."""
        return bool(self._genicam.IsReadable(self._map.GetNode(name)))

    def read(self, name: str) -> Feature:
        """Return the device's value."""
        kind = self.kind(name)
        value = self._asked(lambda: self._map.GetNode(name).GetValue())
        if kind == "boolean":
            return bool(value)
        return float(value) if kind == "float" else int(value) if kind == "integer" else str(value)

    def write(self, name: str, value: Feature) -> None:
        """Write a value that suits the feature's kind."""
        self._asked(lambda: self._map.GetNode(name).SetValue(value))

    def execute(self, name: str) -> None:
        """Execute a command."""
        self._asked(lambda: self._map.GetNode(name).Execute())

    def limits(self, name: str) -> tuple[float, float, float]:
        """Return the least and largest value and the step (0 where there is none) of a number."""
        node = self._map.GetNode(name)
        stepped = self.kind(name) == "integer" or node.HasInc()
        limits: tuple[float, float, float] = self._asked(
            lambda: (node.GetMin(), node.GetMax(), node.GetInc() if stepped else 0.0)
        )
        return limits

    def entries(self, name: str) -> tuple[str, ...]:
        """Return the entries of an enumeration that are available just now."""
        return tuple(self._asked(lambda: self._map.GetNode(name).GetSymbolics()))

    def _asked(self, question: Any) -> Any:
        try:
            return question()
        except self._error as error:
            raise FeatureRefused(first_line(error)) from None


class PylonCamera(GenICamCamera):
    """One Basler camera.

    Its stamps count ticks of its own clock: of GevTimestampTickFrequency where it has that (ace GigE: 8 ns), else
    of 1 ns. By Basler's manuals the stamp is "generated when frame acquisition was triggered". With one exposure
    per trigger this is the start of exposure, except for the trigger's own delay of some microseconds.
    """

    def __init__(self, pylon: ModuleType, name: str, device: Device, camera: Any, emulated: bool) -> None:
        self._pylon, self._camera, self._emulated = pylon, camera, emulated
        self._error_type = _pylon_error(pylon)
        self._blocks = BlockIds()
        self._failed = 0
        camera.Open()
        try:
            super().__init__(name, device, PylonFeatures(pylon, camera))
        except BaseException:
            camera.Close()
            raise
        ticks_hz = number(self.features, "GevTimestampTickFrequency")
        self._ticks_hz = int(ticks_hz) if ticks_hz else 10**9

    def _asked(self) -> Capabilities:
        asked = capabilities_of(self.features, device_clock=not self._emulated)
        if not self._emulated:
            return asked
        # the emulator lists lines and actions that nothing can raise
        return Capabilities(
            software_trigger=asked.software_trigger, window=asked.window, max_triggered_hz=asked.max_triggered_hz
        )

    def _configured(self, settings: CameraHardware) -> DeviceReport:
        if self._emulated and settings.trigger not in ("Off", "Software"):
            raise self._error(f"is emulated: trigger = '{settings.trigger}' would never fire; allowed: Software, Off")
        return super()._configured(settings)

    def _start(self) -> None:
        self._camera.MaxNumBuffer.Value = BUFFERS
        self._blocks = BlockIds()
        self._failed = 0
        try:
            self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)
        except self._error_type as error:
            raise self._error(f"does not start ({first_line(error)})") from None

    def _fetch(self, timeout_s: float) -> Grabbed | None:
        pylon = self._pylon
        try:
            result = self._camera.RetrieveResult(max(0, round(timeout_s * 1000)), pylon.TimeoutHandling_Return)
        except self._error_type as error:
            raise self._gone(first_line(error)) from None
        host_ns = time.monotonic_ns()
        if not result.IsValid():
            if self._camera.IsCameraDeviceRemoved():
                raise self._gone("pylon says that it was removed")
            return None
        try:
            return self._grabbed(result, host_ns)
        finally:
            result.Release()

    def _grabbed(self, result: Any, host_ns: int) -> Grabbed:
        image = None
        if result.GrabSucceeded():
            with result.GetImageMemoryView() as memory:
                image, note = whole_image(
                    np.frombuffer(memory, np.uint8),
                    result.GetPixelType() & 0xFFFFFFFF,
                    result.GetWidth(),
                    result.GetHeight(),
                    result.GetPaddingX(),
                )
        else:
            note = f"FAILED 0x{result.GetErrorCode():08X} {' '.join(result.GetErrorDescription().split())}"
            self._failed += 1
        stamp = result.GetTimeStamp() if self.capabilities.device_clock else 0
        return Grabbed(
            block_id=self._blocks.unwrapped(result.GetBlockID()),
            device_ns=stamp * 10**9 // self._ticks_hz if stamp else None,
            host_ns=host_ns,
            exposure_ns=self._exposure_ns,
            image=image,
            note=note,
        )

    def _await_ready(self) -> None:
        # the device silently ignores a trigger that comes too early
        camera = self._camera
        try:
            # in polls: time in which this process was stalled does not count
            ready = not camera.CanWaitForFrameTriggerReady() or any(
                camera.WaitForFrameTriggerReady(READY_MS // READY_LOOKS, self._pylon.TimeoutHandling_Return)
                for _ in range(READY_LOOKS)
            )
        except self._error_type as error:
            raise self._gone(first_line(error)) from None
        if not ready:
            raise self._error(f"was not ready for a trigger within {READY_MS} ms")

    def _stop(self) -> None:
        try:
            self._camera.StopGrabbing()
        except self._error_type as error:
            raise self._error(f"does not stop ({first_line(error)})") from None

    def _counts(self) -> Mapping[str, int]:
        streams = self._camera.GetStreamGrabberNodeMap()
        counts = {}
        for node in streams.GetNodes():
            name = node.GetNode().GetName()
            if name.startswith(STATISTICS) and not name.endswith("_Reg") and hasattr(node, "GetValue"):
                counts[name] = int(node.GetValue())
        return {**counts, "failed_results": self._failed}

    def _free(self) -> None:
        self._camera.Close()
        self._camera.DestroyDevice()
