"""The cameras that the drivers find, and those of them that a rig file names. None is opened."""

from collections.abc import Callable, Sequence
from pathlib import Path

from hardware.driver import Device, DeviceError
from hardware.drivers import devices
from hardware.settings import DRIVERS, CameraHardware, read_hardware

ListDevices = Callable[[str, str], Sequence[Device]]


def describe_devices(path: Path | None, list_devices: ListDevices = devices) -> tuple[list[str], list[str]]:
    """Return a line for each device and each driver that cannot search, then one for each camera of the rig file; and
    the names of the rig file's cameras that no driver finds.
    """
    cameras = {} if path is None else read_hardware(path).cameras
    producers = sorted({settings.producer for settings in cameras.values() if settings.producer})
    asked = [(driver, "") for driver in DRIVERS if driver != "gentl"] + [("gentl", p) for p in producers]
    lines: list[str] = []
    found: list[Device] = []
    for driver, producer in asked:
        try:
            seen = list_devices(driver, producer)
        except DeviceError as error:
            lines.append(str(error))
            continue
        found += seen
        if not seen:
            lines.append(f"{driver}: no cameras")
    lines = [f"{d.driver}: {d.model or 'camera'}, serial {d.serial or '-'}, at {d.address}" for d in found] + lines
    if not producers:
        lines.append("gentl: looks through a rig file's producers (.cti); name the rig file to see their cameras")
    absent = []
    for name, settings in cameras.items():
        device = next((d for d in found if d.driver == settings.driver and _is(settings, d)), None)
        wanted = f"serial {settings.serial}" if settings.serial else f"at {settings.address}"
        if device is None:
            absent.append(name)
            lines.append(f"camera '{name}': NOT FOUND ({settings.driver}, {wanted})")
        else:
            lines.append(f"camera '{name}': {device.model or settings.driver}, {wanted}, is there")
    return lines, absent


def _is(settings: CameraHardware, device: Device) -> bool:
    if settings.serial:
        return settings.serial == device.serial
    return settings.address == device.address
