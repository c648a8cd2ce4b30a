"""Take-over of a GigE Vision camera from a killed program of this user and machine, without waiting.

The standard's *primary application switchover* (GigE Vision 1.1 and later, optional): bit 21 of the GVCP Capability
register (0x0934; bits counted from the least significant) shows that a camera has it. Its controller writes a key of
16 bits to the Control Switchover Key register (0x095C, write-only), and control_access (bit 1) with
control_switchover_enable (bit 2) to the Control Channel Privilege register (CCP, 0x0A00). From then on another
program gets the control by writing control_access with the key in the upper 16 bits to CCP. Sources: Aravis,
``src/arvgvcpprivate.h`` (capability); Wireshark, ``packet-gvcp.c`` (registers and fields); MATRIX VISION,
mvBlueCOUGAR-X manual, "Using the primary application switchover functionality" (order of the steps).

The camera of a running program is never taken over. The controller keeps its key in a file of this user, which it
locks while the camera is open: the kernel frees the lock when the process ends, however it ends. The key is used only
where that lock is free, the camera's controller is still that of the file, and no program on this machine has its
port.
"""

import contextlib
import logging
import os
import secrets
from pathlib import Path
from typing import TextIO

from hardware.drivers.aravis_library import Aravis, AravisError
from hardware.gvcp import CONTROL_ACCESS, KEY_BITS, PRIVILEGE_REGISTER, SWITCHOVER_CAPABILITY, SWITCHOVER_ENABLE

log = logging.getLogger("mosca.hardware.drivers")

MAC_REGISTERS = (0x0008, 0x000C)
CAPABILITY_REGISTER, KEY_REGISTER, STREAM_PORT_REGISTER = 0x0934, 0x095C, 0x0D00
Controller = tuple[str, int]
"""Address and UDP port of the program that controls a camera, as the camera states them."""


class ControlSwitchover:
    """The key of one camera: ``take_over`` uses the last controller's key, ``enable`` sets a new one until ``close``.

    Without the capability, or without a place for the key, both do nothing.
    """

    def __init__(self, aravis: Aravis, device: int) -> None:
        self._aravis, self._device = aravis, device
        self._file: TextIO | None = None

    def take_over(self, controller: Controller) -> bool:
        """Take the control from ``controller``, whose port no program has any more; return whether that worked.

        An acquisition that it left running is stopped, and its stream closed.
        """
        file = self._locked()
        key = None if file is None else _key(file, controller)
        if key is None:
            self.close()
            return False
        aravis, device = self._aravis, self._device
        try:
            # without control_switchover_enable: nobody else can use the old key from here on
            aravis("device_write_register", device, PRIVILEGE_REGISTER, key << KEY_BITS | CONTROL_ACCESS)
            aravis("gv_device_take_control", device)
        except AravisError as error:
            log.debug("control switchover refused: %s", error)
            self.close()
            return False
        # a camera that does not acquire may refuse the first, and does not need the second
        with contextlib.suppress(AravisError):
            aravis("device_execute_command", device, b"AcquisitionStop")
        with contextlib.suppress(AravisError):
            aravis("device_write_register", device, STREAM_PORT_REGISTER, 0)
        return True

    def enable(self, controller: Controller | None) -> None:
        """Allow this user's next program to take the camera over when this one, its ``controller``, is killed."""
        file = None if controller is None else self._locked()
        if file is None or controller is None:
            return
        # other programs that ask for control write the key 0
        key = secrets.randbelow((1 << KEY_BITS) - 1) + 1
        aravis, device = self._aravis, self._device
        try:
            file.seek(0)
            file.truncate()
            file.write(f"{key} {controller[0]} {controller[1]}\n")
            file.flush()
            aravis("device_write_register", device, KEY_REGISTER, key)
            aravis("device_write_register", device, PRIVILEGE_REGISTER, CONTROL_ACCESS | SWITCHOVER_ENABLE)
        except (OSError, AravisError) as error:
            # the lock is kept: the camera may have accepted the key all the same
            log.debug("no control switchover: %s", error)

    def close(self) -> None:
        """Release the file; may be called twice."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):  # what could not be written before
                file.close()

    def _locked(self) -> TextIO | None:
        """Return the camera's file, locked; None where there is none, or another process has it."""
        if self._file is not None:
            return self._file
        capability, *mac = (self._aravis.register(self._device, one) for one in (CAPABILITY_REGISTER, *MAC_REGISTERS))
        if not (capability or 0) & SWITCHOVER_CAPABILITY or None in mac:
            return None
        try:
            import fcntl
        except ImportError:  # Windows: without flock nothing shows whether the last controller runs
            return None
        try:
            folder = _folder()
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            path = folder / f"{mac[0]:08x}{mac[1]:08x}.key"
            file = open(path, "a+", encoding="ascii", opener=_private)  # noqa: SIM115 (closed by close)
        except (OSError, RuntimeError) as error:  # RuntimeError: a user without a home
            log.debug("no file for the key of control switchover: %s", error)
            return None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            log.debug("%s: %s", path, error)
            file.close()
            return None
        self._file = file
        return file


def _folder() -> Path:
    """Return this user's folder of keys (XDG Base Directory Specification: $XDG_STATE_HOME)."""
    state = os.environ.get("XDG_STATE_HOME", "")
    return (Path(state) if os.path.isabs(state) else Path.home() / ".local/state") / "mosca/control_keys"


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _key(file: TextIO, controller: Controller) -> int | None:
    """Return the key that ``controller`` left; None where the file is another controller's, or damaged."""
    file.seek(0)
    try:
        key, address, port = file.read().split()
        known = (address, int(port)) == controller and 0 < int(key) < 1 << KEY_BITS
        return int(key) if known else None
    except ValueError:
        return None
