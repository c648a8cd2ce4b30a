"""Trigger sources: a pulse generator, software, scheduled actions, a master camera, or an external one."""

from collections.abc import Mapping

from hardware.driver import CameraDriver, DeviceError
from hardware.settings import RigHardware
from hardware.trigger import External, Trigger
from hardware.triggers.action import ActionTrigger
from hardware.triggers.serial_box import SerialTrigger
from hardware.triggers.software import SoftwareTrigger


def open_trigger(rig: RigHardware, drivers: Mapping[str, CameraDriver]) -> Trigger:
    """Return the rig's trigger, stopped; DeviceError where it is missing or a camera cannot follow it."""
    table = rig.shared.trigger
    rate_hz = rig.shared.rate_hz
    match table.source:
        case "serial":
            try:
                return SerialTrigger(table.port, table.baud, rate_hz)
            except ImportError as error:
                raise DeviceError(
                    f"{rig.path}: [hardware.trigger] source 'serial' cannot be used ({error}); "
                    "pip install 'mosca-testbench[serial]'"
                ) from None
        case "software":
            return SoftwareTrigger(drivers, rate_hz)
        case "action":
            return ActionTrigger(table, rate_hz)
    # a master camera's exposures are the pulses: it needs to be armed last, nothing else
    return External()
