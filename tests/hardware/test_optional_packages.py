"""Without the extras' packages everything can be imported; what needs one fails with a message of one line."""

import subprocess
import sys

import pytest

from hardware.driver import DeviceError
from hardware.settings import CameraHardware, HardwareTable, RigHardware, TriggerTable
from hardware.triggers import open_trigger

OPTIONAL = ("pylsl", "foxglove", "serial", "pypylon", "harvesters", "genicam", "zenoh", "pyGigEVision")
IMPORT_ALL = f"""
import importlib, pkgutil, sys
for name in {OPTIONAL}:
    sys.modules[name] = None
import hardware, scenarios.lab, scenarios.cli.main
for package in (hardware, scenarios.lab):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if module.name != "hardware.transport.zenoh_engine":  # the engine itself, imported when it is opened
            importlib.import_module(module.name)
"""


def test_all_modules_are_imported_without_optional_packages():
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_serial_trigger_without_pyserial_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    table = HardwareTable(trigger=TriggerTable(source="serial", port="/dev/ttyACM0"))
    camera = CameraHardware(driver="gige", serial="1")
    rig = RigHardware(tmp_path / "rig.toml", table, {"a": camera}, {"a": (2, 2)})
    with pytest.raises(DeviceError, match=r"rig.toml: .*'serial' cannot be used .*mosca-testbench\[serial\]"):
        open_trigger(rig, {})
