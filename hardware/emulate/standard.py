"""Numbers of the GigE Vision standard (version 2.0) that device and packets share."""

from enum import IntEnum

GVCP_PORT = 3956
GVCP_KEY = 0x42
LARGEST_GVCP_PAYLOAD = 540
IP_UDP_BYTES = 28
GVSP_HEADER_BYTES = 8
PACKET_OVERHEAD = IP_UDP_BYTES + GVSP_HEADER_BYTES
"""SCPS counts IP and UDP headers too; without options they and the GVSP header take 36 bytes of a packet."""
VERSION_2_0 = 0x00020000
MAXIMUM_BLOCK_ID = 65535
TICKS_PER_SECOND = 1_000_000_000


class Command(IntEnum):
    """Control commands; an acknowledgement has the command's number plus 1."""

    DISCOVERY = 0x0002
    FORCEIP = 0x0004
    PACKETRESEND = 0x0040
    READREG = 0x0080
    WRITEREG = 0x0082
    READMEM = 0x0084
    WRITEMEM = 0x0086
    ACTION = 0x0100


class Status(IntEnum):
    """Status codes of acknowledgements and stream packets."""

    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    PACKET_UNAVAILABLE = 0x800C
    INVALID_HEADER = 0x800E
    NO_REF_TIME = 0x8013
    OVERFLOW = 0x8015
    ACTION_LATE = 0x8016


ACKNOWLEDGE = 0x01
"""Flag of every command: an answer is wanted."""
ALLOW_BROADCAST_ACK = 0x10
EXTENDED_ID = 0x10
"""Flag of PACKETRESEND: 64 bit block numbers, which this device does not use."""
SCHEDULED = 0x80
"""Flag of ACTION: a time follows."""

EXCLUSIVE_ACCESS = 0x1
CONTROL_ACCESS = 0x2

LEADER, TRAILER, PAYLOAD = 1, 2, 3
IMAGE_PAYLOAD = 0x0001
EXTENDED_CHUNKS = 0x4000
"""Of the payload's type: chunks follow the image."""
IMAGE_CHUNK, COUNTER_CHUNK = 0x0000C001, 0x0000C002
CHUNK_TAIL_BYTES = 8
"""What stands after a chunk's data: its number and its length."""

FIRE_TEST_PACKET = 0x80000000
DO_NOT_FRAGMENT = 0x40000000

PIXEL_FORMATS = {"Mono8": 0x01080001, "Mono10": 0x01100003, "Mono12": 0x01100005, "Mono16": 0x01100007}
"""Numbers of the Pixel Format Naming Convention; all but Mono8 take two bytes a pixel, little-endian."""
FORMAT_OF_DEPTH = {8: "Mono8", 10: "Mono10", 12: "Mono12", 16: "Mono16"}


class Refused(Exception):
    """What a client asked for is not to be had; ``status`` goes into the acknowledgement."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.name)
        self.status = status
