"""Emulated cameras on the network: one device for each camera of a source, and their trigger line."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from ipaddress import IPv4Address, IPv4Interface
from threading import Event, Thread

import numpy as np

from hardware.emulate.acquisition import SECOND, PendingImage
from hardware.emulate.camera import EmulatedCamera
from hardware.emulate.control import Control, check_address, control_sockets
from hardware.emulate.faults import FAULTLESS, FaultDraws, Faults
from hardware.emulate.gige_vision import FORMAT_OF_DEPTH, PIXEL_FORMATS
from hardware.emulate.identity import Identity
from hardware.emulate.pulse_generators import TriggerLine
from hardware.emulate.store import FrameStore
from hardware.emulate.stream import ImageLayout, Stream, image_packets
from mosca.data.arrays import Array
from mosca.data.frames import CameraInfo, Frame, FrameSource
from mosca.errors import InputError

IDLE_S = 0.5


class EmulatedDevice:
    """Serves on ``identity``'s address until ``close``.

    ``frames``: gives the source's frame of a pulse, None where there is none; called from the device's thread.
    """

    def __init__(
        self,
        identity: Identity,
        frames: Callable[[int], Frame | None],
        faults: Faults = FAULTLESS,
        first_block: int = 1,
    ) -> None:
        draws = FaultDraws(faults, identity.serial)
        self._frames = frames
        sockets = control_sockets(identity)
        self._stream = Stream(str(identity.address.ip), draws)
        self.camera = EmulatedCamera(identity, self._stream, faults, draws, first_block)
        self.control = Control(self.camera, self._stream, sockets)
        self._stop = Event()
        self._images: Counter[str] = Counter()
        self._thread = Thread(target=self._run, name=f"gvsp {identity.name}", daemon=True)
        self._thread.start()

    @property
    def identity(self) -> Identity:
        """Identity of the device."""
        return self.camera.identity

    def counts(self) -> Mapping[str, int]:
        """Return the counts of triggers, images and packets until now."""
        return {**self.camera.counts, **self._images, **self._stream.counts}

    def close(self) -> None:
        """Leave the network; may be called twice."""
        if self._stop.is_set():
            return
        self._stop.set()
        with self.camera.changed:
            self.camera.changed.notify_all()
        self._thread.join()
        self.control.close()
        self._stream.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            with self.camera.changed:
                found = self.camera.next_image()
                if not isinstance(found, PendingImage):
                    self.camera.changed.wait(IDLE_S if found is None else min(found, IDLE_S))
                    continue
            self._take(found)

    def _take(self, shot: PendingImage) -> None:
        """Wait until the image is read out, and send it; where that cannot be done, count why."""
        self._stop.wait(max(shot.exposure.out_ns - time.monotonic_ns(), 0) / SECOND)
        frame = self._frames(shot.exposure.number)
        with self.camera.changed:
            to, packet_bytes = self.camera.destination(), self.camera.packet_bytes
            stopped = shot.session != self.camera.session or self._stop.is_set()
        if stopped or to is None:
            self._images["aborted"] += 1
            return
        if not self.camera.linked(time.monotonic_ns()):
            self._images["unheard"] += 1
            return
        if frame is None or frame.status == "dropped":
            self._images["dropped"] += 1
            return
        pixels = pixels_of(frame, shot.layout, self.identity.bit_depth)
        packets = image_packets(shot.block, shot.device_ns, shot.layout, pixels, packet_bytes, shot.chunks)
        # a frame that is damaged in the source arrives damaged: its end is missing and cannot be requested again
        packets = packets if frame.status == "ok" else packets[:-1]
        self._images["frames" if frame.status == "ok" else "corrupt"] += 1
        self._stream.send(shot.block, packets, to)


def pixels_of(frame: Frame, layout: ImageLayout, depth: int) -> Array:
    """Return the region of ``frame``'s image that ``layout`` selects, in its pixel format.

    ``depth``: significant bits of the source's pixels; Mono8 takes the highest eight. A damaged frame has no
    image: its packets are black.
    """
    rows = slice(layout.offset_y, layout.offset_y + layout.height)
    columns = slice(layout.offset_x, layout.offset_x + layout.width)
    wanted = np.uint8 if layout.pixel_format == PIXEL_FORMATS["Mono8"] else np.uint16
    if frame.image is None:
        return np.zeros((layout.height, layout.width), wanted)
    image = frame.image[rows, columns]
    if wanted == np.uint8 and depth > 8:
        image = image >> (depth - 8)
    return image.astype(wanted, copy=False)


FIRST_ADDRESS = "127.0.0.2"
SLOWEST_SENSOR_HZ = 200.0
EXPOSURE_US = 1000.0
LOOPBACK_BITS, LAN_BITS = 8, 24
SERIAL_BYTES = 16
"""Length of a serial number with the zero at its end."""


class Served:
    """Devices of a source's cameras, in its order, and their line; ``close`` takes them off the network."""

    def __init__(
        self, store: FrameStore, devices: Sequence[EmulatedDevice], rate_hz: float, resources: ExitStack
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
        """Trigger the cameras with pulse ``number`` of an external generator; pulse 0 begins with frame 0."""
        if number == 0:
            self.store.rewind()
        if not self._ended(number):
            self.line.pulse(number, time_ns)

    def device(self, name: str) -> EmulatedDevice:
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
    switchover: bool = False,
    progress: Callable[[int, int | None], None] | None = None,
) -> Served:
    """Return the cameras of ``source`` as GigE Vision devices, once ``ahead`` pulses of frames are in memory.

    Raises InputError for an address that is not available, a name that the source does not have, or frames that
    cannot be sent.

    Parameters
    ----------
    source
        Frames to serve; it is not closed.
    ahead
        Pulses of frames to read into memory.
    loop
        Whether the first frame follows the last.
    first_address
        The cameras' addresses count up from it ("127.0.0.2", or "192.168.7.10/24" on an interface that has them).
    addresses, serials
        By camera; default serials are made of the addresses (TWIN7F000002).
    faults
        By camera.
    first_block
        Block id of an acquisition's first frame.
    switchover
        Whether another client may take over the control with a key (a capability that many cameras lack).
    progress
        Called with pulses done and to do while frames are read ahead.
    """
    infos = source.cameras
    names = tuple(info.name for info in infos)
    for what, given in (("addresses", addresses), ("serials", serials), ("faults", faults)):
        for name in given or {}:
            if name not in names:
                raise InputError(f"{what}: camera '{name}' given; the source has {', '.join(names)}")
    places = _places(names, first_address, addresses or {})
    for name, place in zip(names, places, strict=True):
        check_address(name, place)  # before frames are rendered, which may take minutes
    with ExitStack() as stack:
        store = FrameStore(source, ahead, loop)
        stack.callback(store.close)
        store.fill(progress)
        devices = []
        for k, info in enumerate(infos):
            identity = _identity(info, places[k], (serials or {}).get(info.name) or serial_at(places[k]), store)
            identity = replace(identity, switchover=switchover)
            own = (faults or {}).get(info.name, FAULTLESS)
            device = EmulatedDevice(identity, partial(store.frame, info.name), own, first_block)
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
    """Return the serial number of the camera at address ``place``: clients identify cameras by it, across servers."""
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
        info.name, serial, place, info.width, info.height, info.bit_depth, info.frame_rate_hz, exposure_us, fastest_hz
    )
