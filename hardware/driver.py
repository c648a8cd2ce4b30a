"""Interface of the camera drivers, one for each vendor's software.

A driver opens one camera, configures it, arms it and returns the buffers it grabbed, with the camera's block id and
device clock. It does not group, repair or guess: ``Capabilities`` states what the device cannot do, and ``configure``
refuses a setting that the device did not accept. Names are GenICam's (SFNC). A driver is used by one thread at a
time, except ``software_trigger``, ``clock`` and ``close``, which may be called from another.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol

from hardware.settings import CameraHardware
from mosca.data.arrays import Array
from mosca.data.frames import StampEvent
from mosca.errors import MoscaError

REFUSED = "refused packets of"
"""Prefix of the names of those counts of a driver that show who else sent to a camera's ports."""


class DeviceError(MoscaError):
    """A camera or trigger that is missing, busy, refuses a setting or stopped answering; in one line."""


@dataclass(frozen=True)
class Capabilities:
    """Capabilities of a device, read from it or known for its kind; False or None where unknown."""

    device_clock: bool = False
    """Time stamps of the camera's own clock."""
    stamp_event: StampEvent = "exposure_start"
    """The event that the time stamps mark."""
    hardware_trigger: bool = False
    software_trigger: bool = False
    scheduled_action: bool = False
    """GigE Vision action commands with a time of execution."""
    ptp: bool = False
    window: bool = False
    """Readout of a part of the sensor, for higher rates."""
    trigger_counter: bool = False
    """Sends its count of trigger pulses."""
    max_triggered_hz: float | None = None
    """Highest trigger rate at the present settings [1/s]."""
    real_time: bool = True
    """Whether frames come as they are taken; False for a file that is played."""


@dataclass(frozen=True, eq=False)
class Grabbed:
    """One buffer as it was received."""

    block_id: int | None
    """Block id of the stream, unwrapped by the driver where the protocol wraps it; None without one."""
    device_ns: int | None
    """Time stamp of the device clock [ns]; None without one."""
    host_ns: int
    """Host clock (``time.monotonic_ns``) when the buffer was complete [ns]."""
    exposure_ns: int
    image: Array | None
    """(H, W) uint8 or uint16, owned by the receiver; None where it is not complete."""
    note: str = ""
    """Why the image is not complete (packets missing, buffer failed)."""
    triggers: int | None = None
    """The camera's count of pulses on its trigger line at this frame; None where it sends none."""

    @property
    def unidentified(self) -> bool:
        """Whether the packet that identifies the frame was lost: no image, block id nor stamp."""
        return self.image is None and self.block_id is None and self.device_ns is None


@dataclass(frozen=True)
class ClockReading:
    """A reading of a device clock: ``device_ns`` between ``before_ns`` and ``after_ns`` of the host clock."""

    device_ns: int
    before_ns: int
    after_ns: int

    @property
    def host_ns(self) -> int:
        """Host time half-way [ns]."""
        return (self.before_ns + self.after_ns) // 2

    @property
    def error_ns(self) -> int:
        """Largest error of ``host_ns`` [ns]."""
        return (self.after_ns - self.before_ns) // 2


@dataclass(frozen=True)
class DeviceReport:
    """A configured device: its names, the settings as read back, and the size of its frames."""

    model: str
    serial: str
    width: int
    height: int
    bit_depth: int
    exposure_ns: int
    settings: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "settings", MappingProxyType(dict(self.settings)))


class CameraDriver(Protocol):
    """One camera: constructed open (or DeviceError), ``configure``, ``arm``, ``grab`` ..., ``disarm``, ``close``.

    ``arm`` and ``disarm`` may alternate. All raise DeviceError in one line that names the camera and what to do.
    """

    @property
    def capabilities(self) -> Capabilities:
        """What this device can do."""
        ...

    def configure(self, settings: CameraHardware) -> DeviceReport:
        """Set the device and read it back; DeviceError where it accepted another value than the one requested."""
        ...

    def arm(self) -> None:
        """Begin to wait for triggers (or to run free) with empty buffers; returns when the device is ready."""
        ...

    def grab(self, timeout_s: float) -> Grabbed | None:
        """Return the next buffer, failed ones too, or None when none came within ``timeout_s``."""
        ...

    def software_trigger(self) -> int:
        """Fire one exposure where ``capabilities.software_trigger``; return this machine's time of it [ns]."""
        ...

    def clock(self) -> ClockReading | None:
        """Return a reading of the device clock, the clock of the stamps; None where it cannot be read."""
        ...

    def disarm(self) -> None:
        """Stop; buffers that are still being transferred are dropped."""
        ...

    def statistics(self) -> Mapping[str, int]:
        """Return the driver's own counts since ``arm`` (packets resent, buffers failed, underruns), by its names."""
        ...

    def close(self) -> None:
        """Free the device; may be called twice."""
        ...


@dataclass(frozen=True)
class Device:
    """A camera that a driver finds, before it is opened."""

    driver: str
    model: str
    serial: str
    address: str
    """Address by which the driver opens it."""
