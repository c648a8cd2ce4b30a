"""Check of the answers to a broadcast discovery: any machine may answer, with any content and name.

Each device is queried again at the address that it gave, by a socket that receives from there only.
"""

import ipaddress
import logging
import selectors
import socket
import time
from collections.abc import Sequence

from hardware.driver import Device
from hardware.drivers.opened import described
from hardware.gvcp import ACK_HEADER, GVCP_KEY, GVCP_PORT, HEADER, Command

log = logging.getLogger("mosca.hardware.drivers")
_REQUEST = 0x5A5A
_QUESTION = HEADER.pack(GVCP_KEY, 0x01, Command.DISCOVERY, 0, _REQUEST)
CONTENT_BYTES = 248
"""Bytes of the bootstrap registers from 0 on; the address and the serial number are at 36 and 216."""
_ADDRESS, _SERIAL = slice(36, 40), slice(216, 232)
WAIT_S, ASK_AGAIN_S = 1.0, 0.2
"""Longest wait for an answer, as long as the library listens to broadcasts; query interval, as packets get lost."""


def confirmed(found: Sequence[Device]) -> list[Device]:
    """Return those of ``found`` that answer at their own address with their serial number; log the others."""
    asked: dict[Device, socket.socket] = {}
    answers: dict[Device, str] = {}
    with selectors.DefaultSelector() as selector:
        try:
            for device in found:
                try:
                    asked[device] = _asking(device.address)
                    selector.register(asked[device], selectors.EVENT_READ, device)
                except (OSError, ValueError) as error:
                    answers[device] = f"its address cannot be used ({error})"
            until = again = time.monotonic()
            until += WAIT_S
            while asked.keys() - answers.keys() and (now := time.monotonic()) < until:
                if now >= again:
                    again = now + ASK_AGAIN_S
                    for device in asked.keys() - answers.keys():
                        _send(asked[device])
                for key, _ in selector.select(max(again - time.monotonic(), 0.0)):
                    answers[key.data] = _refusal(key.data, asked[key.data])
                    selector.unregister(key.fileobj)
        finally:
            for one in asked.values():
                one.close()
    for device in found:
        why = answers.get(device, "nothing answers at that address; is it in the network of this interface?")
        if why:
            log.warning("%s: answers to broadcasts, but %s; it is left out", described(device), why)
    return [device for device in found if answers.get(device) == ""]


def _asking(address: str) -> socket.socket:
    ip = ipaddress.IPv4Address(address)
    if ip.is_unspecified or ip.is_multicast:
        raise ValueError("no device's")
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.setblocking(False)
        made.connect((address, GVCP_PORT))
    except OSError:
        made.close()
        raise
    return made


def _send(asking: socket.socket) -> None:
    try:
        asking.send(_QUESTION)
    except OSError as error:  # nothing is there: the wait ends without an answer, which is reported
        log.debug("discovery of %s: %s", asking, error)


def _refusal(device: Device, asking: socket.socket) -> str:
    """Return why the answer is not that of ``device``, "" where it is."""
    try:
        data = asking.recv(2048)
    except OSError as error:
        return f"nothing takes questions at that address ({error.strerror})"
    content = data[ACK_HEADER.size :]
    head = (0, Command.DISCOVERY + 1, CONTENT_BYTES, _REQUEST)
    if len(content) != CONTENT_BYTES or ACK_HEADER.unpack_from(data) != head:
        return "its answer is not one of GigE Vision"
    address, serial = socket.inet_ntoa(content[_ADDRESS]), content[_SERIAL].split(b"\0")[0].decode(errors="replace")
    if (address, serial) != (device.address, device.serial):
        return f"'{serial}' at {address} is what answers there"
    return ""
