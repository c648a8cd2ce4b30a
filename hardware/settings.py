"""The hardware tables of a rig file, checked: ``[camera.hardware]`` and ``[hardware]``.

::

    [camera.hardware]
    driver = "gige"                 # gige (Aravis), pylon (Basler), gentl (any vendor's .cti), webcam
    serial = "22345678"             # or address = "192.168.7.11" (webcam: its number or file)
    trigger = "Line1"               # TriggerSource: Line0 .. Line9, Software, Action1; Off runs free
    exposure_us = 800.0             # ExposureTime
    gain_db = 0.0                   # Gain
    pixel_format = "Mono8"          # Mono8, Mono10, Mono12, Mono16; BayerXX8 and colour are reduced to mono
    trigger_counter = false         # true: gige cameras that can send their count of pulses, which shows lost ones
    window = [0, 128, 656, 256]     # OffsetX, OffsetY, Width, Height: windowed readout; default: the whole sensor
    features = { AcquisitionFrameRateEnable = false }    # anything else by its GenICam name

    [hardware]
    rate_hz = 100.0                 # of the pulses, or of the free-running cameras
    [hardware.trigger]
    source = "serial"               # serial, software, action, master, external
    port = "/dev/ttyACM0"
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from mosca.data.files.rig_file import read_rig_file
from mosca.data.files.toml import NotNegative, Positive, Table, check
from mosca.errors import InputError

DRIVERS = ("gige", "pylon", "gentl", "webcam")
PIXEL_FORMATS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16}
Feature = bool | int | float | str


class CameraHardware(Table):
    """``[camera.hardware]``: which device this camera is, and how it is set."""

    driver: Literal["gige", "pylon", "gentl", "webcam"]
    serial: str = Field("", description="the device's serial number")
    address: str = Field("", description="IP address, device number or file, where a serial does not identify it")
    trigger: str = Field("Line1", description="TriggerSource; Off runs free")
    trigger_activation: Literal["RisingEdge", "FallingEdge"] = "RisingEdge"
    exposure_us: Positive | None = Field(None, description="ExposureTime [us]; without it the device's own is kept")
    gain_db: NotNegative | None = Field(None, description="Gain; without it the device's own is kept")
    pixel_format: str = Field("Mono8", description="PixelFormat: " + ", ".join(PIXEL_FORMATS))
    window: Annotated[tuple[int, int, int, int], Field(description="OffsetX, OffsetY, Width, Height [px]")] | None = (
        None
    )
    packet_bytes: int | None = Field(None, ge=576, le=16000, description="GevSCPSPacketSize [bytes]")
    producer: str = Field("", description="gentl: the vendor's .cti file")
    trigger_counter: bool = Field(
        False, description="gige: the camera counts the pulses on its line and sends the count with each frame"
    )
    features: dict[str, Feature] = Field(default_factory=dict, description="more, by GenICam name")

    @field_validator("trigger")
    @classmethod
    def _source(cls, name: str) -> str:
        if not re.fullmatch(r"Off|Software|Action[1-9]|Line[0-9]", name):
            raise ValueError("Off, Software, Line0 to Line9 and Action1 to Action9 are allowed")
        return name

    @model_validator(mode="after")
    def _named(self) -> "CameraHardware":
        if not self.serial and not self.address:
            raise ValueError("serial or address is needed to tell this camera from the others")
        if self.driver == "gentl" and not self.producer:
            raise ValueError("driver 'gentl' needs producer, the path of the vendor's .cti file")
        if self.trigger_counter and (self.driver != "gige" or not self.trigger.startswith("Line")):
            raise ValueError("trigger_counter counts the pulses of a line (Line0 to Line9) with driver 'gige'")
        if self.window is not None and (min(self.window[:2]) < 0 or min(self.window[2:]) < 1):
            raise ValueError(f"window {list(self.window)}: offsets from 0, width and height from 1 are wanted")
        return self


class TriggerTable(Table):
    """``[hardware.trigger]``: what makes the pulses."""

    source: Literal["serial", "software", "action", "master", "external"] = "external"
    port: str = Field("", description="serial: the port of the pulse generator, e.g. /dev/ttyACM0")
    baud: int = Field(115200, gt=0)
    camera: str = Field("", description="master: the camera whose exposures trigger the others")
    device_key: int = Field(1, ge=0, description="action: ActionDeviceKey")
    group_key: int = Field(1, ge=0, description="action: ActionGroupKey")
    group_mask: int = Field(1, ge=1, description="action: ActionGroupMask")
    broadcast: str = Field("255.255.255.255", description="action: where the action commands go")
    lead_ms: NotNegative = Field(
        0.0, description="action: how far ahead it is scheduled [ms]; the cameras' clocks must agree by PTP"
    )
    ptp_ahead_s: float = Field(
        0.0, description="action: PTP time less this machine's UTC [s]; 37 where the master gives TAI"
    )

    @model_validator(mode="after")
    def _whole(self) -> "TriggerTable":
        if self.source == "serial" and not self.port:
            raise ValueError("source 'serial' needs port")
        if self.source == "master" and not self.camera:
            raise ValueError("source 'master' needs camera, the one whose exposures trigger the others")
        return self

    @property
    def makes_pulses(self) -> bool:
        """Whether this computer starts and stops the pulses; else they come from a camera or from outside."""
        return self.source in ("serial", "software", "action")


class HardwareTable(Table):
    """``[hardware]``: what all cameras share."""

    rate_hz: Positive = Field(100.0, description="rate of the pulses, or of the free-running cameras [1/s]")
    trigger: TriggerTable = TriggerTable()
    wait_s: Positive = Field(
        60.0, description="a take of stated length ends where no pulse comes in so long from its beginning [s]"
    )
    time_error_ms: Positive = Field(
        1.0, description="a frame whose time may be off by more is in doubt, and its frame set is not complete [ms]"
    )
    accept_unproven: bool = Field(
        False, description="true: frames whose pulses only arrival times tell complete their frame sets, too"
    )
    silence_s: Positive = Field(2.0, description="a camera that is silent for so long is noted")


@dataclass(frozen=True)
class RigHardware:
    """The hardware side of a rig file: ``cameras`` (name -> settings), ``sizes`` (name -> width, height [px])."""

    path: Path
    shared: HardwareTable
    cameras: Mapping[str, CameraHardware]
    sizes: Mapping[str, tuple[int, int]]

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", MappingProxyType(dict(self.cameras)))
        object.__setattr__(self, "sizes", MappingProxyType(dict(self.sizes)))


def read_hardware(path: Path) -> RigHardware:
    """Return the hardware tables of the rig file at ``path``; InputError where it is wrong."""
    path = Path(path)
    document = read_rig_file(path)
    shared = check(HardwareTable, document.hardware, f"{path}: [hardware]")
    cameras: dict[str, CameraHardware] = {}
    for table in document.camera:
        if not table.hardware:
            raise InputError(
                f"{path}: camera '{table.name}' has no [camera.hardware]; say which device it is: "
                f"driver ({', '.join(DRIVERS)}) and serial"
            )
        if table.name in cameras:
            raise InputError(f"{path}: camera name '{table.name}' stands twice; give each camera its own name")
        cameras[table.name] = check(
            CameraHardware, table.hardware, f"{path}: camera '{table.name}' [camera.hardware]"
        )
    twice = _used_twice(cameras)
    if twice is not None:
        raise InputError(f"{path}: cameras '{twice[0]}' and '{twice[1]}' name the same device ({twice[2]})")
    if shared.trigger.source == "master" and shared.trigger.camera not in cameras:
        raise InputError(
            f"{path}: [hardware.trigger] camera '{shared.trigger.camera}' is none of {', '.join(cameras)}"
        )
    return RigHardware(path, shared, cameras, {table.name: table.size for table in document.camera})


def _used_twice(cameras: Mapping[str, CameraHardware]) -> tuple[str, str, str] | None:
    seen: dict[tuple[str, str, str], str] = {}
    for name, settings in cameras.items():
        device = (settings.driver, settings.serial, settings.address)
        if device in seen:
            return seen[device], name, settings.serial or settings.address
        seen[device] = name
    return None
