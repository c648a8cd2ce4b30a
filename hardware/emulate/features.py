"""Registers for clients: the standard's bootstrap registers, and features by their SFNC names."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

from hardware.emulate.gige_vision import COUNTER_CHUNK, PIXEL_FORMATS
from hardware.emulate.registers import Access, Kind, Register

FEATURES_START = 0x10000
XML_START = 0xF0000
FeatureKind = Literal["integer", "float", "enumeration", "boolean", "command", "string"]
TRIGGER_SOURCES = {"Software": 0, "Line1": 1, "Action1": 2}
ACQUISITION_MODES = {"Continuous": 0, "SingleFrame": 1, "MultiFrame": 2}
ACTIVATIONS = {"RisingEdge": 0, "FallingEdge": 1}
COUNTER_SOURCES = {"Off": 0, "Line1": 1}
PTP_STATES = {"Disabled": 3, "Listening": 4, "Uncalibrated": 8, "Slave": 9}

BOOTSTRAP = (
    Register("Version", 0x0000),
    Register("DeviceMode", 0x0004),
    Register("MACHigh", 0x0008),
    Register("MACLow", 0x000C),
    Register("IPConfigurationOptions", 0x0010),
    Register("IPConfiguration", 0x0014, access="RW"),
    Register("CurrentIP", 0x0024),
    Register("CurrentSubnet", 0x0034),
    Register("CurrentGateway", 0x0044),
    Register("VendorName", 0x0048, 32, kind="text"),
    Register("ModelName", 0x0068, 32, kind="text"),
    Register("DeviceVersion", 0x0088, 32, kind="text"),
    Register("ManufacturerInfo", 0x00A8, 48, kind="text"),
    Register("SerialNumber", 0x00D8, 16, kind="text"),
    Register("UserName", 0x00E8, 16, "RW", "text"),
    Register("FirstURL", 0x0200, 512, kind="text"),
    Register("SecondURL", 0x0400, 512, kind="text"),
    Register("NetworkInterfaces", 0x0600),
    Register("PersistentIP", 0x064C),
    Register("PersistentSubnet", 0x065C),
    Register("PersistentGateway", 0x066C),
    Register("MessageChannels", 0x0900),
    Register("StreamChannels", 0x0904),
    Register("ActionSignals", 0x0908),
    Register("ActionDeviceKey", 0x090C, access="RW"),
    Register("StreamCapability", 0x092C),
    Register("MessageCapability", 0x0930),
    Register("ControlCapability", 0x0934),
    Register("HeartbeatTimeout", 0x0938, access="RW"),
    Register("TickFrequency", 0x093C, 8),
    Register("TimestampControl", 0x0944, access="WO"),
    Register("TimestampLatched", 0x0948, 8),
    Register("DiscoveryDelay", 0x0950),
    Register("ControlConfiguration", 0x0954, access="RW"),
    Register("PendingTimeout", 0x0958),
    Register("SwitchoverKey", 0x095C, access="WO"),
    Register("StreamConfiguration", 0x0960, access="RW"),
    Register("ControlPrivilege", 0x0A00, access="RW"),
    Register("PrimaryPort", 0x0A04),
    Register("PrimaryIP", 0x0A14),
    Register("StreamPort", 0x0D00, access="RW"),
    Register("StreamPacketSize", 0x0D04, access="RW"),
    Register("StreamPacketDelay", 0x0D08, access="RW"),
    Register("StreamDestination", 0x0D18, access="RW"),
    Register("StreamSourcePort", 0x0D1C),
    Register("StreamCapability0", 0x0D20),
    Register("StreamConfiguration0", 0x0D24),
    Register("ActionGroupKey", 0x9800, access="RW"),
    Register("ActionGroupMask", 0x9804, access="RW"),
)


@dataclass(frozen=True)
class Feature:
    """One node of the feature tree and the register behind it."""

    name: str
    kind: FeatureKind
    category: str | None
    """None for a node that only others refer to."""
    access: Access = "RW"
    minimum: float | None = None
    maximum: float | None = None
    increment: float | None = None
    most: str = ""
    """Register of the largest value allowed now."""
    unit: str = ""
    entries: Mapping[str, int] = field(default_factory=dict)
    locked: bool = False
    """Not to be written while the camera acquires."""
    register: str = ""
    """Its bootstrap register; "" gives the feature one of its own."""
    bits: tuple[int, int] | None = None
    """First and last bit of the value in the register, counted from the most significant."""
    command: int = 1
    signed: bool = False
    length: int = 4
    selects: tuple[str, ...] = ()
    """Features that depend on this selector."""
    tip: str = ""
    chunk: int = 0
    """Id of the chunk that holds the value behind each image, instead of a register."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "entries", MappingProxyType(dict(self.entries)))


def features(pixel_formats: tuple[str, ...]) -> tuple[Feature, ...]:
    """Return the features of a camera that has ``pixel_formats``."""
    return (
        tuple(_image(pixel_formats))
        + tuple(_acquisition())
        + tuple(_counting())
        + tuple(_device())
        + tuple(_transport())
    )


def own_registers(tree: tuple[Feature, ...]) -> tuple[Register, ...]:
    """Return the registers of the features that have one of their own, one after the other."""
    found, address = [], FEATURES_START
    for feature in tree:
        if not feature.register and not feature.chunk:
            length = 8 if feature.kind == "float" else feature.length
            kind: Kind = "unsigned"
            if feature.kind in ("float", "string"):
                kind = "double" if feature.kind == "float" else "text"
            elif feature.signed:
                kind = "signed"
            found.append(Register(feature.name, address, length, feature.access, kind))
            address += length
    return tuple(found)


def _image(pixel_formats: tuple[str, ...]) -> Iterator[Feature]:
    here = Feature("", "integer", "ImageFormatControl", minimum=1)
    fixed = replace(here, access="RO")
    yield replace(fixed, name="SensorWidth", unit="px", tip="Width of the whole sensor.")
    yield replace(fixed, name="SensorHeight", unit="px", tip="Height of the whole sensor.")
    yield replace(fixed, name="WidthMax", unit="px")
    yield replace(fixed, name="HeightMax", unit="px")
    for name, most in (("Width", "WidthLimit"), ("Height", "HeightLimit")):
        yield replace(here, name=name, most=most, increment=1, unit="px", locked=True)
    for name, most in (("OffsetX", "OffsetXLimit"), ("OffsetY", "OffsetYLimit")):
        yield replace(here, name=name, minimum=0, most=most, increment=1, unit="px", locked=True)
    formats = {name: PIXEL_FORMATS[name] for name in pixel_formats}
    yield Feature("PixelFormat", "enumeration", "ImageFormatControl", entries=formats, locked=True)
    for name in ("WidthLimit", "HeightLimit", "OffsetXLimit", "OffsetYLimit"):
        yield Feature(name, "integer", None, "RO")


def _acquisition() -> Iterator[Feature]:
    here = "AcquisitionControl"
    yield Feature("AcquisitionMode", "enumeration", here, entries=ACQUISITION_MODES, locked=True)
    yield Feature("AcquisitionStart", "command", here, "WO")
    yield Feature("AcquisitionStop", "command", here, "WO")
    yield Feature("AcquisitionFrameCount", "integer", here, minimum=1, maximum=65535, locked=True)
    yield Feature(
        "AcquisitionFrameRateEnable",
        "boolean",
        here,
        tip="On: a free-running camera keeps AcquisitionFrameRate; off: as fast as it can.",
    )
    yield Feature(
        "AcquisitionFrameRate",
        "float",
        here,
        minimum=0.01,
        most="AcquisitionFrameRateLimit",
        unit="Hz",
        tip="Rate of a free-running camera.",
    )
    yield Feature("AcquisitionFrameRateLimit", "float", None, "RO")
    yield Feature("ExposureMode", "enumeration", here, entries={"Timed": 0})
    yield Feature("ExposureTime", "float", here, minimum=1.0, maximum=1e7, increment=0.01, unit="us")
    selected = ("TriggerMode", "TriggerSource", "TriggerActivation", "TriggerSoftware")
    yield Feature("TriggerSelector", "enumeration", here, entries={"FrameStart": 0}, selects=selected)
    yield Feature("TriggerMode", "enumeration", here, entries={"Off": 0, "On": 1})
    yield Feature("TriggerSource", "enumeration", here, entries=TRIGGER_SOURCES)
    yield Feature("TriggerActivation", "enumeration", here, entries=ACTIVATIONS)
    yield Feature("TriggerSoftware", "command", here, "WO")
    yield Feature("Gain", "float", "AnalogControl", minimum=0.0, maximum=48.0, increment=0.01, unit="dB")


def _counting() -> Iterator[Feature]:
    """A counter of the pulses on the line, and its value behind each image."""
    here, behind = "CounterAndTimerControl", "ChunkDataControl"
    selected = ("CounterEventSource", "CounterEventActivation", "CounterValue", "CounterReset")
    yield Feature("CounterSelector", "enumeration", here, entries={"Counter0": 0}, selects=selected)
    yield Feature("CounterEventSource", "enumeration", here, entries=COUNTER_SOURCES)
    yield Feature("CounterEventActivation", "enumeration", here, entries=ACTIVATIONS)
    yield Feature("CounterValue", "integer", here, "RO", tip="Pulses on the line, those that the camera ignores too.")
    yield Feature("CounterReset", "command", here, "WO")
    yield Feature("ChunkModeActive", "boolean", behind, locked=True)
    entries = {"CounterValue": 0}
    yield Feature("ChunkSelector", "enumeration", behind, entries=entries, selects=("ChunkEnable",))
    yield Feature("ChunkEnable", "boolean", behind, locked=True)
    yield Feature("ChunkCounterValue", "integer", behind, "RO", chunk=COUNTER_CHUNK)


def _device() -> Iterator[Feature]:
    here = Feature("", "string", "DeviceControl", "RO")
    for name, register in (
        ("DeviceVendorName", "VendorName"),
        ("DeviceModelName", "ModelName"),
        ("DeviceManufacturerInfo", "ManufacturerInfo"),
        ("DeviceVersion", "DeviceVersion"),
        ("DeviceSerialNumber", "SerialNumber"),
    ):
        yield replace(here, name=name, register=register)
    yield replace(here, name="DeviceFirmwareVersion", length=16)
    yield replace(here, name="DeviceUserID", register="UserName", access="RW")
    yield Feature("DeviceReset", "command", "DeviceControl", "WO")
    latch = Feature("", "command", "DeviceControl", "WO", register="TimestampControl")
    yield replace(latch, name="TimestampLatch", command=2)
    yield replace(latch, name="TimestampReset", command=1)
    yield Feature("TimestampLatchValue", "integer", "DeviceControl", "RO", unit="ns", register="TimestampLatched")
    yield Feature("PtpEnable", "boolean", "PtpControl")
    yield Feature("PtpDataSetLatch", "command", "PtpControl", "WO")
    yield Feature("PtpStatus", "enumeration", "PtpControl", "RO", entries=PTP_STATES)
    yield Feature("PtpOffsetFromMaster", "integer", "PtpControl", "RO", unit="ns", signed=True, length=8)
    for name in ("ActionDeviceKey", "ActionGroupKey", "ActionGroupMask"):
        maximum = 2**32 - 1
        yield Feature(name, "integer", "ActionControl", minimum=0, maximum=maximum, register=name)


def _transport() -> Iterator[Feature]:
    here = "TransportLayerControl"
    yield Feature("PayloadSize", "integer", here, "RO", unit="B")
    yield Feature(
        "GevSCPSPacketSize",
        "integer",
        here,
        minimum=576,
        maximum=16000,
        increment=4,
        unit="B",
        locked=True,
        register="StreamPacketSize",
        bits=(16, 31),
    )
    yield Feature("GevSCPSDoNotFragment", "boolean", here, locked=True, register="StreamPacketSize", bits=(1, 1))
    yield Feature("GevSCPSFireTestPacket", "command", here, register="StreamPacketSize", bits=(0, 0))
    yield Feature("GevSCPHostPort", "integer", here, locked=True, register="StreamPort", bits=(16, 31))
    yield Feature("GevSCDA", "integer", here, locked=True, register="StreamDestination")
    yield Feature("GevHeartbeatTimeout", "integer", here, minimum=500, maximum=2**31 - 1, unit="ms",
                  register="HeartbeatTimeout")  # fmt: skip
    yield Feature("GevCurrentIPAddress", "integer", here, "RO", register="CurrentIP")
    yield Feature("GevTimestampTickFrequency", "integer", here, "RO", unit="Hz", register="TickFrequency")
    latch = Feature("", "command", here, "WO", register="TimestampControl")
    yield replace(latch, name="GevTimestampControlLatch", command=2)
    yield replace(latch, name="GevTimestampControlReset", command=1)
    yield Feature("GevTimestampValue", "integer", here, "RO", unit="ns", register="TimestampLatched")
