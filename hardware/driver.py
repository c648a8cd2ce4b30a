"""What a camera driver is: the one door behind which each vendor's software stands.

A driver opens one camera, sets it, arms it and yields what it grabbed, with the camera's own counter and clock. It
does not group, does not repair and does not guess: what the device cannot do, its ``Capabilities`` say; what it
did not take, ``configure`` refuses. Names are GenICam's (SFNC). A driver is used by one thread at a time,
except ``software_trigger``, ``clock`` and ``close``, which may come from another.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol

from hardware.settings import CameraHardware
from mosca.data.arrays import Array
from mosca.data.frames import StampEvent
from mosca.errors import MoscaError


class DeviceError(MoscaError):
    """A camera or trigger that is missing, busy, refuses a setting or stopped answering; told in one line."""


@dataclass(frozen=True)
class Capabilities:
    """What a device can do, asked of the device or known of its kind; False or None where it is not known.

    ``device_clock``: stamps of the camera's own clock; ``stamp_event``: what they mark, ``exposure_start`` for
    most triggered cameras. ``hardware_trigger``, ``software_trigger``, ``scheduled_action``, ``ptp``, ``window``
    (readout of a part, for higher rates). ``trigger_counter``: reports ignored triggers. ``max_triggered_hz``:
    the highest rate of triggers that it keeps up with at its present settings. ``real_time``: frames come as they are
    taken; False for a file that is played.
    """

    device_clock: bool = False
    stamp_event: StampEvent = "exposure_start"
    hardware_trigger: bool = False
    software_trigger: bool = False
    scheduled_action: bool = False
    ptp: bool = False
    window: bool = False
    trigger_counter: bool = False
    max_triggered_hz: float | None = None
    real_time: bool = True


@dataclass(frozen=True, eq=False)
class Grabbed:
    """One buffer as it came: what the camera says, and when this machine saw it.

    ``block_id``: the stream's own number of the frame, unwrapped by the driver where the protocol wraps it, or
    None. ``device_ns``: the camera's stamp in its own clock, None without one. ``host_ns``: this machine's
    monotonic clock (``time.monotonic_ns``) when the buffer was whole. ``image``: (H, W) uint8 or uint16, owned by
    the receiver, or None where it is not whole; ``note`` then says why (packets missing, buffer failed).
    ``triggers``: the camera's own count of pulses on its trigger line at this frame, None where it tells none.
    """

    block_id: int | None
    device_ns: int | None
    host_ns: int
    exposure_ns: int
    image: Array | None
    note: str = ""
    triggers: int | None = None

    @property
    def nameless(self) -> bool:
        """Whether it is what came of a frame without the packet that says which: no image, number nor stamp."""
        return self.image is None and self.block_id is None and self.device_ns is None


@dataclass(frozen=True)
class ClockReading:
    """A camera's clock beside this machine's: it showed ``device_ns`` between ``before_ns`` and ``after_ns``."""

    device_ns: int
    before_ns: int
    after_ns: int

    @property
    def host_ns(self) -> int:
        """Half-way, by this machine's clock."""
        return (self.before_ns + self.after_ns) // 2

    @property
    def error_ns(self) -> int:
        """How far off that may be."""
        return (self.after_ns - self.before_ns) // 2


@dataclass(frozen=True)
class DeviceReport:
    """What a device took: its names, the settings as read back, and the size of its frames."""

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
        """Set the device and read it back; DeviceError where it took another value than was asked for."""
        ...

    def arm(self) -> None:
        """Begin to wait for triggers (or to run free) with empty buffers; returns when the device is ready."""
        ...

    def grab(self, timeout_s: float) -> Grabbed | None:
        """Return the next buffer, failed ones too, or None when none came within ``timeout_s``."""
        ...

    def software_trigger(self) -> int:
        """Fire one exposure where ``capabilities.software_trigger``; return this machine's time [ns] then."""
        ...

    def clock(self) -> ClockReading | None:
        """Return what the camera's clock shows now, the clock of the stamps; None where it cannot be asked."""
        ...

    def disarm(self) -> None:
        """Stop; buffers that are still under way are dropped."""
        ...

    def statistics(self) -> Mapping[str, int]:
        """Return the driver's own counts since ``arm`` (packets resent, buffers failed, underruns), by its names."""
        ...

    def close(self) -> None:
        """Free the device; may be called twice."""
        ...


@dataclass(frozen=True)
class Device:
    """A camera that a driver sees, before it is opened; ``address``: whatever the driver opens it by."""

    driver: str
    model: str
    serial: str
    address: str
