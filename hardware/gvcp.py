"""Numbers of GigE Vision's control protocol (GVCP, GigE Vision 2.0) that drivers, triggers and the emulator share."""

import struct
from enum import IntEnum

GVCP_PORT = 3956
GVCP_KEY = 0x42
"""First byte of every command."""
HEADER = struct.Struct(">BBHHH")
"""Header of a command: key, flags, command, bytes that follow, number of the request."""
ACK_HEADER = struct.Struct(">HHHH")
"""Header of an acknowledgement: status, command, bytes that follow, number of the request."""
SCHEDULED = 0x80
"""Flag of ACTION: a time follows."""

PRIVILEGE_REGISTER = 0x0A00
"""Control Channel Privilege (CCP): the bits below, and in the upper 16 the switchover key of a requester."""
EXCLUSIVE_ACCESS, CONTROL_ACCESS, SWITCHOVER_ENABLE = 0x1, 0x2, 0x4
SWITCHOVER_CAPABILITY = 1 << 21
"""Bit of the GVCP Capability register: another program may take over control (primary application switchover)."""
KEY_BITS = 16


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
