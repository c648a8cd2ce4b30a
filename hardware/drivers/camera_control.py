"""Control of a GigE Vision camera that another program holds, or held when it was killed.

A camera obeys one program, its controller. A controller that ends without giving the control back (``kill -9``, a
crash) keeps it until the camera has received no sign of life from it for the heartbeat time-out, unless the camera
can be taken over (``hardware.drivers.control_switchover``).
"""

import errno
import logging
import socket
import time

from hardware.driver import DeviceError
from hardware.drivers.aravis_library import Aravis, AravisError
from hardware.drivers.control_switchover import Controller, ControlSwitchover

log = logging.getLogger("mosca.hardware.drivers")

# bootstrap registers: heartbeat time-out [ms], the controller's port and its address (optional: 0 where not stated)
HEARTBEAT_REGISTER, PORT_REGISTER, ADDRESS_REGISTER = 0x0938, 0x0A04, 0x0A14
# longest wait; half of it is too short for some cameras' own time-outs, twice of it looks hung
LONGEST_WAIT_S = 30.0
# cameras check the time only at intervals
MARGIN_S = 2.0
AGAIN_S = 0.2


def wait_for_control(aravis: Aravis, device: int, camera: str, switchover: ControlSwitchover) -> None:
    """Take the control of a camera as soon as the program that holds it has been silent for the heartbeat time-out.

    Control is taken at once where that program was killed on this machine and left its key.

    Parameters
    ----------
    aravis
        The library.
    device
        The library's device, which does not control the camera.
    camera
        The camera in words, for the messages.
    switchover
        Its key.

    Raises
    ------
    DeviceError
        The controlling program is alive, or the camera would wait for it for longer than ``LONGEST_WAIT_S``.
    """
    holder = controller_of(aravis, device)
    who = "another program" if holder is None else f"another program ({holder[0]}:{holder[1]})"
    alive = None if holder is None else _alive(holder)
    if alive:
        raise DeviceError(f"{camera} is controlled by {who} of this machine, which runs; close that first")
    heartbeat_ms = aravis.register(device, HEARTBEAT_REGISTER)
    if heartbeat_ms is None:
        raise DeviceError(f"{camera} is controlled by {who}, which lets nobody else read; close that first")
    wait_s = heartbeat_ms / 1e3
    if holder is not None and alive is False and switchover.take_over(holder):
        log.warning(
            "%s was still controlled by %s, which has ended, and would let go after %g s: taken over",
            camera,
            who,
            wait_s,
        )
        return
    if wait_s > LONGEST_WAIT_S:
        raise DeviceError(
            f"{camera} is controlled by {who}, and lets go {wait_s:g} s after that has ended; close that and wait, "
            "or switch the camera off and on"
        )
    ended = "which has ended" if alive is False else "which may have ended"
    log.warning("%s is still controlled by %s, %s; it lets go after %g s: waiting", camera, who, ended, wait_s)
    until = time.monotonic() + wait_s + MARGIN_S
    while time.monotonic() < until:
        if _taken(aravis, device):
            return
        time.sleep(AGAIN_S)
    raise DeviceError(
        f"{camera} is controlled by {who}, which runs: it did not let go in {wait_s:g} s; close that first"
    )


def _taken(aravis: Aravis, device: int) -> bool:
    try:
        return bool(aravis("gv_device_take_control", device))
    except AravisError as error:
        log.debug("control refused: %s", error)
        return False


def controller_of(aravis: Aravis, device: int) -> Controller | None:
    """Return address and port of the controller; None where the camera does not state them."""
    port, address = (aravis.register(device, one) for one in (PORT_REGISTER, ADDRESS_REGISTER))
    if not port or not address:
        return None
    return socket.inet_ntoa(address.to_bytes(4, "big")), port & 0xFFFF


def _alive(holder: Controller) -> bool | None:
    """Whether a program of this machine has the port; None for another machine's address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind(holder)
        except OSError as error:
            return True if error.errno == errno.EADDRINUSE else None
    return False
