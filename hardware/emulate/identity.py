"""Identity of an emulated camera, and the values of its registers at power-on."""

from dataclasses import dataclass
from ipaddress import IPv4Interface

from hardware.emulate.features import XML_START
from hardware.emulate.gige_vision import FORMAT_OF_DEPTH, PIXEL_FORMATS, TICKS_PER_SECOND, VERSION_2_0
from hardware.emulate.registers import Value
from hardware.gvcp import SWITCHOVER_CAPABILITY

BIG_ENDIAN_UTF8 = 0x80000001
PERSISTENT_IP, DHCP, LINK_LOCAL = 1, 2, 4
LOCALLY_ADMINISTERED = 0x0200
"""First two bytes of a MAC address that no manufacturer has."""
CONTROL_CAPABILITY = (
    1 << 31  # user-defined name
    | 1 << 30  # serial number
    | 1 << 27  # port and address of the controller
    | 1 << 26  # test packets hold data
    | 1 << 22  # extended status codes
    | 1 << 19  # IEEE 1588
    | 1 << 17  # scheduled actions
    | 1 << 6  # actions
    | 1 << 2  # packet resend
    | 1 << 1  # WRITEMEM
    | 1  # several registers a command
)
SOURCE_PORT_CAPABILITY = 1 << 31
HEARTBEAT_MS = 3000
PACKET_BYTES = 1500


@dataclass(frozen=True)
class Identity:
    """Names, address and sensor of an emulated camera."""

    name: str
    """Name of the source's camera."""
    serial: str
    address: IPv4Interface
    """IP address with the length of its network prefix."""
    width: int
    height: int
    bit_depth: int
    rate_hz: float
    """Frame rate of the source, and the setting at power-on."""
    exposure_us: float
    """Exposure time of the source, and the setting at power-on."""
    fastest_hz: float
    """Highest frame rate of the whole sensor."""
    vendor: str = "Mosca"
    model: str = "Twin"
    firmware: str = "1.0"
    switchover: bool = False
    """Whether another client may take over the control with a key; many cameras have no such capability."""


def boot_values(identity: Identity, xml_bytes: int, source_port: int) -> dict[str, Value]:
    """Return the registers' values at power-on; all others are 0 or empty."""
    address = int(identity.address.ip)
    return {
        "Version": VERSION_2_0,
        "DeviceMode": BIG_ENDIAN_UTF8,
        "MACHigh": LOCALLY_ADMINISTERED,
        "MACLow": address,
        "IPConfigurationOptions": PERSISTENT_IP | LINK_LOCAL,
        "IPConfiguration": PERSISTENT_IP | LINK_LOCAL,
        "CurrentIP": address,
        "CurrentSubnet": int(identity.address.netmask),
        "PersistentIP": address,
        "PersistentSubnet": int(identity.address.netmask),
        "VendorName": identity.vendor,
        "ModelName": identity.model,
        "DeviceVersion": identity.firmware,
        "DeviceFirmwareVersion": identity.firmware,
        "ManufacturerInfo": "frames of a source, not of a sensor",
        "SerialNumber": identity.serial,
        "UserName": identity.name[:15],
        "FirstURL": f"Local:mosca_twin.xml;{XML_START:x};{xml_bytes:x}",
        "NetworkInterfaces": 1,
        "StreamChannels": 1,
        "ActionSignals": 1,
        "StreamCapability": SOURCE_PORT_CAPABILITY,
        "StreamSourcePort": source_port,
        "ControlCapability": CONTROL_CAPABILITY | (SWITCHOVER_CAPABILITY if identity.switchover else 0),
        "HeartbeatTimeout": HEARTBEAT_MS,
        "TickFrequency": TICKS_PER_SECOND,
        "StreamPacketSize": PACKET_BYTES,
        "SensorWidth": identity.width,
        "SensorHeight": identity.height,
        "WidthMax": identity.width,
        "HeightMax": identity.height,
        "Width": identity.width,
        "Height": identity.height,
        "PixelFormat": PIXEL_FORMATS[FORMAT_OF_DEPTH[identity.bit_depth]],
        "AcquisitionFrameCount": 1,
        "AcquisitionFrameRateEnable": 1,
        "AcquisitionFrameRate": identity.rate_hz,
        "ExposureTime": identity.exposure_us,
    }
