"""One vendor SDK a file, imported when it is opened."""

import importlib
from collections.abc import Sequence
from types import ModuleType

from hardware.driver import CameraDriver, Device, DeviceError
from hardware.settings import DRIVERS, CameraHardware

EXTRAS = {
    "gige": "install Aravis (Debian: apt install libaravis-0.8-0)",
    "pylon": "pip install 'mosca-testbench[pylon]'",
    "gentl": "pip install 'mosca-testbench[gentl]'",
    "webcam": "reinstall the project: opencv is among its dependencies",
}


def open_camera(name: str, settings: CameraHardware) -> CameraDriver:
    """Open the device of camera ``name``; DeviceError where the SDK, the device or its permission is missing."""
    module = _module(settings.driver, f"camera '{name}'")
    driver: CameraDriver = module.open_camera(name, settings)
    return driver


def devices(driver: str, producer: str = "") -> Sequence[Device]:
    """Return the cameras that ``driver`` sees now; ``producer``: gentl's .cti file."""
    module = _module(driver, f"driver '{driver}'")
    found: Sequence[Device] = module.devices(producer)
    return found


def _module(driver: str, where: str) -> ModuleType:
    if driver not in DRIVERS:
        raise DeviceError(f"{where}: driver '{driver}' is unknown; there are {', '.join(DRIVERS)}")
    module = importlib.import_module(f"hardware.drivers.{driver}")
    try:
        module.load()
    except ImportError as error:
        raise DeviceError(f"{where}: driver '{driver}' cannot be used ({error}); {EXTRAS[driver]}") from None
    return module
