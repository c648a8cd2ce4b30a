"""Puts the cameras of a source on the network, one device each, and their trigger line beside them."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from ipaddress import IPv4Address, IPv4Interface

from hardware.emulate.device import Device
from hardware.emulate.faults import FAULTLESS, Faults
from hardware.emulate.identity import Identity
from hardware.emulate.line import TriggerLine
from hardware.emulate.standard import FORMAT_OF_DEPTH
from hardware.emulate.store import FrameStore
from mosca.data.frames import CameraInfo, FrameSource
from mosca.errors import InputError

FIRST_ADDRESS = "127.0.0.2"
SLOWEST_SENSOR_HZ = 200.0
EXPOSURE_US = 1000.0
LOOPBACK_BITS, LAN_BITS = 8, 24
SERIAL_BYTES = 16
"""With the zero at its end."""


class Served:
    """Devices of a source's cameras, in its order, and their line; ``close`` takes them off the network."""

    def __init__(
        self, store: FrameStore, devices: Sequence[Device], rate_hz: float, resources: ExitStack
    ) -> None:
        self.store, self.devices, self.rate_hz = store, tuple(devices), rate_hz
        self.line = TriggerLine([device.camera for device in devices], self._ended)
        self._resources = resources

    def start(self, rate_hz: float | None = None) -> None:
        """Start the line with pulse 0 and frame 0, at ``rate_hz`` or at the rate of the source."""
        self.line.stop()
        self.store.rewind()
        self.line.start(rate_hz or self.rate_hz)

    def pulse(self, number: int, time_ns: int) -> None:
        """Hand on pulse ``number`` of another generator than the own one; pulse 0 begins with frame 0."""
        if number == 0:
            self.store.rewind()
        if not self._ended(number):
            self.line.pulse(number, time_ns)

    def device(self, name: str) -> Device:
        """Return the device of camera ``name``."""
        for device in self.devices:
            if device.identity.name == name:
                return device
        raise KeyError(name)

    def close(self) -> None:
        """Stop the line, then the devices, then reading; may be called twice."""
        self.line.stop()
        self._resources.close()

    def __enter__(self) -> "Served":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _ended(self, pulse: int) -> bool:
        last = self.store.last_pulse
        return last is not None and pulse > last


def served(
    source: FrameSource,
    *,
    ahead: int = 200,
    loop: bool = False,
    first_address: str = FIRST_ADDRESS,
    addresses: Mapping[str, str] | None = None,
    serials: Mapping[str, str] | None = None,
    faults: Mapping[str, Faults] | None = None,
    first_block: int = 1,
    progress: Callable[[int, int | None], None] | None = None,
) -> Served:
    """Return the cameras of ``source`` as GigE Vision devices, once ``ahead`` pulses of frames are in memory.

    The cameras take successive addresses from ``first_address`` ("127.0.0.2", or "192.168.7.10/24" on an interface
    that has them), or those of ``addresses`` by name; serials are made of the addresses (TWIN7F000002), or are those
    of ``serials``. ``loop``: after the last frame comes the first. ``faults``: by camera. ``first_block``: the
    stream's number of an acquisition's first frame. The source stays its owner's to close. Raises InputError for an
    address that is not to be had, a name that the source does not have, or frames that cannot be sent.
    """
    infos = source.cameras
    names = tuple(info.name for info in infos)
    for what, given in (("addresses", addresses), ("serials", serials), ("faults", faults)):
        for name in given or {}:
            if name not in names:
                raise InputError(f"{what}: camera '{name}' given; the source has {', '.join(names)}")
    places = _places(names, first_address, addresses or {})
    with ExitStack() as stack:
        store = FrameStore(source, ahead, loop)
        stack.callback(store.close)
        store.fill(progress)
        devices = []
        for k, info in enumerate(infos):
            identity = _identity(
                info, places[k], (serials or {}).get(info.name) or serial_at(places[k]), store
            )
            own = (faults or {}).get(info.name, FAULTLESS)
            device = Device(identity, partial(store.frame, info.name), own, first_block)
            stack.callback(device.close)
            devices.append(device)
        rate_hz = infos[0].frame_rate_hz if infos else 1.0
        return Served(store, devices, rate_hz, stack.pop_all())


def interface(text: str) -> IPv4Interface:
    """Return the address that ``text`` gives, with the length of its network: 8 bits on loopback, else 24."""
    try:
        found = IPv4Interface(text)
    except ValueError:
        raise InputError(
            f"address '{text}': an IPv4 address is wanted, such as {FIRST_ADDRESS} or 192.168.7.10/24"
        ) from None
    if "/" in text:
        return found
    return IPv4Interface(f"{text}/{LOOPBACK_BITS if found.is_loopback else LAN_BITS}")


def serial_at(place: IPv4Interface) -> str:
    """Return the serial number of a camera at ``place``: clients tell cameras apart by it, also of two servers."""
    return f"TWIN{int(place.ip):08X}"


def _places(names: Sequence[str], first: str, given: Mapping[str, str]) -> list[IPv4Interface]:
    start = interface(first)
    places = [
        interface(given[name])
        if given.get(name)
        else IPv4Interface(f"{IPv4Address(int(start.ip) + k)}/{start.network.prefixlen}")
        for k, name in enumerate(names)
    ]
    used = [place.ip for place in places]
    for name, place in zip(names, places, strict=True):
        if used.count(place.ip) > 1:
            raise InputError(f"camera '{name}': address {place.ip} is given twice; each camera needs its own")
    return places


def _identity(info: CameraInfo, place: IPv4Interface, serial: str, store: FrameStore) -> Identity:
    if info.bit_depth not in FORMAT_OF_DEPTH:
        allowed = ", ".join(str(depth) for depth in FORMAT_OF_DEPTH)
        raise InputError(f"camera '{info.name}': {info.bit_depth} bits a pixel; {allowed} can be sent")
    if not 0 < len(serial.encode()) < SERIAL_BYTES:
        raise InputError(
            f"camera '{info.name}': serial '{serial}': {SERIAL_BYTES - 1} bytes at most go into a camera's register"
        )
    first = store.first(info.name)
    exposure_us = first.exposure_ns / 1000 if first is not None and first.exposure_ns else EXPOSURE_US
    fastest_hz = max(SLOWEST_SENSOR_HZ, 2 * info.frame_rate_hz)
    return Identity(
        info.name,
        serial,
        place,
        info.width,
        info.height,
        info.bit_depth,
        info.frame_rate_hz,
        exposure_us,
        fastest_hz,
    )
