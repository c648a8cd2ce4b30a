"""GigE Vision cameras of any vendor, through Aravis (LGPL, called as a system library)."""

import contextlib
import ctypes
import logging
import threading
import time
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from hardware.driver import Capabilities, Device, DeviceError, DeviceReport, Grabbed
from hardware.drivers.aravis_features import AravisFeatures
from hardware.drivers.aravis_library import (
    BUFFER_STATUS,
    NO_PACKET_SOCKET,
    PACKET_SIZE_ADJUSTMENT_NEVER,
    Aravis,
    AravisError,
    decoded,
)
from hardware.drivers.aravis_library import load as load_library
from hardware.drivers.blocks import BlockIds
from hardware.drivers.camera_control import HEARTBEAT_REGISTER, PORT_REGISTER, controller_of, wait_for_control
from hardware.drivers.configure import COUNTER_CHUNKS, capabilities_of, counter_chunk
from hardware.drivers.control_switchover import ControlSwitchover
from hardware.drivers.discovery import confirmed
from hardware.drivers.features import text
from hardware.drivers.opened import GenICamCamera, chosen, claim, described, not_found, release
from hardware.drivers.peer_socket import Address, PeerSocket, merged, tied, udp_sockets
from hardware.drivers.pixels import whole_image
from hardware.gvcp import GVCP_PORT
from hardware.settings import CameraHardware

log = logging.getLogger("mosca.hardware.drivers")

PROTOCOL = "GigEVision"
# the library has one list for all
_discovery = threading.RLock()
# the socket of a camera's control channel is recognised as the new one
_opening = threading.Lock()
# a busy camera may answer after the library has stopped listening, which it does for a second
LOOKS = 3
# buffers hold a second at 100 Hz, and no more than a quarter of a gigabyte
BUFFERS, LEAST_BUFFERS, BUFFER_BYTES = 100, 8, 1 << 28
# time without a sign of life after which a camera releases its program; 3 s by default. A machine that stalls for
# some seconds must not lose all its cameras
HEARTBEAT_MS = 10_000
# bootstrap register with the port that the camera streams from; it may be absent, and read 0
STREAM_SOURCE_REGISTER = 0x0D1C
STREAM_PROPERTIES: tuple[tuple[str, str, float], ...] = (
    # bytes that the kernel may keep while this program waits for a core (net.core.rmem_max limits them)
    ("socket-buffer-size", "int", 1 << 23),
    ("packet-resend", "int", 1),
    # time after its last packet at which an incomplete frame is given up [us]
    ("frame-retention", "uint", 200_000),
    # the share of a frame's packets that may be requested again; the library's default, a quarter, gives up frames
    # that lost a burst
    ("packet-request-ratio", "double", 1.0),
)


class _NoAnswer(DeviceError):
    """The library could not open the device at all."""


def load() -> Aravis:
    """Load libaravis; ImportError where it is not installed."""
    return load_library()


def devices(producer: str = "") -> Sequence[Device]:
    """Return the GigE Vision cameras that answer a broadcast on any interface; takes about a second."""
    aravis = load()
    with _discovery:
        aravis("update_device_list")
        found = _listed(aravis)
    return confirmed(found)


def open_camera(name: str, settings: CameraHardware) -> "GigeCamera":
    """Open the camera with the serial number or at the address of ``settings``."""
    aravis = load()
    device = _one(confirmed([one for one in _listed(aravis) if chosen([one], settings)]), name, settings)
    if device is None and settings.address:
        # discovery by unicast: a broadcast does not reach other subnets
        device = Device("gige", "GigE Vision camera", "", settings.address)
    seen: dict[tuple[str, str], Device] = {}
    for _ in range(LOOKS):
        if device is None:
            seen |= {(one.serial, one.address): one for one in devices()}
            device = _one(tuple(seen.values()), name, settings)
    if device is None:
        raise not_found(tuple(seen.values()), name, settings)
    claim(device, name)
    try:
        camera = _opened(aravis, name, device, settings)
    except BaseException:
        release(device)
        raise
    if settings.serial not in ("", camera.device.serial):
        camera.close()
        raise DeviceError(
            f"camera '{name}': serial '{settings.serial}' and address '{settings.address}' are two cameras'; there "
            f"is {described(camera.device)}. Leave one of them out"
        )
    return camera


def _one(found: Sequence[Device], name: str, settings: CameraHardware) -> Device | None:
    """Return the device that the settings name, None where there is none; DeviceError where two have its serial."""
    named = [device for device in found if chosen([device], settings)]
    if len({device.address for device in named}) > 1:
        there = ", ".join(device.address for device in named)
        raise DeviceError(
            f"camera '{name}': serial '{settings.serial}' is told by devices at {there}; one of them is not the "
            "camera: give its address too"
        )
    return named[0] if named else None


def _opened(aravis: Aravis, name: str, device: Device, settings: CameraHardware, tries: int = LOOKS) -> "GigeCamera":
    """Open a camera, with further tries where it does not answer but is there."""
    try:
        return GigeCamera(aravis, name, device)
    except _NoAnswer:
        # not present, or present only at this program's last discovery
        found = devices()
        if chosen(found, settings) is None:
            raise not_found(found, name, settings) from None
        if tries == 1:
            raise
        log.debug("camera '%s': no answer yet, opening it again", name)
    return _opened(aravis, name, device, settings, tries - 1)


def _listed(aravis: Aravis) -> Sequence[Device]:
    with _discovery:
        return [
            Device(
                driver="gige",
                model=decoded(aravis("get_device_model", number)),
                serial=decoded(aravis("get_device_serial_nbr", number)),
                address=decoded(aravis("get_device_address", number)),
            )
            for number in range(aravis("get_n_devices"))
            if decoded(aravis("get_device_protocol", number)) == PROTOCOL
        ]


class GigeCamera(GenICamCamera):
    """One GigE Vision camera under this program's control.

    Stamps are the device clock in ns (the library divides by its tick frequency). GigE Vision requires only that a
    block's stamp marks when its data was generated; cameras stamp the start of exposure, or a fixed delay later.
    """

    def __init__(self, aravis: Aravis, name: str, device: Device) -> None:
        self._aravis = aravis
        self._camera = self._device = self._arv_stream = 0
        self._blocks = BlockIds()
        self._counter: bytes | None = None
        self._chunks = 0
        self._control_socket: PeerSocket | None = None
        self._switchover: ControlSwitchover | None = None
        self._stream_socket: PeerSocket | None = None
        try:
            with _opening:
                before = udp_sockets()
                self._camera = aravis("camera_new", (device.address or device.serial).encode())
                made = {fd: local for fd, local in udp_sockets().items() if before.get(fd) != local}
        except AravisError as error:
            raise _NoAnswer(
                f"camera '{name}': {described(device)} does not open ({error}); check power, cable and network, "
                "and that its address is in the network of this machine's interface"
            ) from None
        try:
            if not aravis("camera_is_gv_device", self._camera):
                raise DeviceError(f"camera '{name}': {described(device)} is no GigE Vision camera")
            self._device = aravis("camera_get_device", self._camera)
            self._switchover = ControlSwitchover(aravis, self._device)
            if not aravis("gv_device_is_controller", self._device):
                wait_for_control(aravis, self._device, f"camera '{name}': {described(device)}", self._switchover)
            super().__init__(name, device, AravisFeatures(aravis, self._device))
            self._tie_control(made.values())
            # a camera that refuses keeps its own time-out, and works as before
            with contextlib.suppress(AravisError):
                aravis("device_write_register", self._device, HEARTBEAT_REGISTER, HEARTBEAT_MS)
            self._switchover.enable(controller_of(aravis, self._device))
            serial = decoded(aravis("camera_get_device_serial_number", self._camera))
            self.device = Device("gige", text(self.features, "DeviceModelName"), serial, device.address)
        except AravisError as error:
            self._let_go()
            raise _NoAnswer(f"camera '{name}': {described(device)} does not answer ({error})") from None
        except BaseException:
            # else it would stay under this program's control, and no program could open it
            self._let_go()
            raise

    def _let_go(self) -> None:
        if self._control_socket is not None:
            self._control_socket.close()
        camera, self._camera, self._device = self._camera, 0, 0
        self._aravis.unref(camera)
        if self._switchover is not None:
            self._switchover.close()

    def _tie_control(self, made: Collection[Address]) -> None:
        """Accept answers from the camera only; ``made``: the sockets that were opened with it."""
        device, aravis = self._device, self._aravis
        here = aravis.ipv4(aravis("gv_device_get_interface_address", device))
        self._peer = aravis.ipv4(aravis("gv_device_get_device_address", device))
        ports = [port for host, port in made if host == here]
        told = aravis.register(device, PORT_REGISTER)
        port = told if told in ports else ports[0] if len(ports) == 1 else 0
        self._here = here
        self._control_socket = tied((here, port), (self._peer, GVCP_PORT), f"camera '{self.name}', control")

    def _tie_stream(self) -> None:
        """Accept the stream from the camera's source port only."""
        aravis = self._aravis
        source = (aravis.register(self._device, STREAM_SOURCE_REGISTER) or 0) & 0xFFFF
        local = (self._here, aravis("gv_stream_get_port", self._arv_stream))
        self._stream_socket = tied(local, (self._peer, source), f"camera '{self.name}', stream")

    def _asked(self) -> Capabilities:
        try:
            ticks = self._aravis("gv_device_get_timestamp_tick_frequency", self._device)
        except AravisError as error:
            raise self._gone(str(error)) from None
        return capabilities_of(self.features, device_clock=ticks > 0)

    def _configure(self, settings: CameraHardware) -> DeviceReport:
        report = super()._configure(settings)
        chunk = counter_chunk(self.features) if settings.trigger_counter else None
        self._counter = None if chunk is None else COUNTER_CHUNKS[chunk].encode()
        if settings.packet_bytes is not None:
            # else the library silently shrinks packets that do not come through
            self._aravis("camera_gv_set_packet_size_adjustment", self._camera, PACKET_SIZE_ADJUSTMENT_NEVER)
        return report

    def _start(self) -> None:
        # a new stream for each start: an old one would take restarted ids for late blocks and drop them
        aravis = self._aravis
        try:
            # as root, packet sockets receive other programs' streams, with ids like ours, until a filter is set
            aravis("camera_gv_set_stream_options", self._camera, NO_PACKET_SOCKET)
            stream = aravis("camera_create_stream", self._camera, None, None)
            if not stream:
                raise self._error("gives no stream; is its address in the network of this interface?")
            self._arv_stream = stream
            self._tie_stream()
            for name, kind, value in STREAM_PROPERTIES:
                aravis.set_property(stream, name, kind, value)
            payload = aravis("camera_get_payload", self._camera)
            for _ in range(max(LEAST_BUFFERS, min(BUFFERS, BUFFER_BYTES // max(1, payload)))):
                aravis("stream_push_buffer", stream, aravis("buffer_new", payload, None))
            self._blocks = BlockIds()
            if self._counter is not None and not self._chunks:
                self._chunks = aravis("camera_create_chunk_parser", self._camera)
            aravis("camera_start_acquisition", self._camera)
        except AravisError as error:
            self._drop_stream()
            raise self._error(f"does not start ({error})") from None

    def _fetch(self, timeout_s: float) -> Grabbed | None:
        aravis = self._aravis
        buffer = aravis("stream_timeout_pop_buffer", self._arv_stream, round(timeout_s * 1e6))
        host_ns = time.monotonic_ns()
        for one in (self._control_socket, self._stream_socket):
            if one is not None:
                one.look()
        if not buffer:
            if not aravis("gv_device_is_controller", self._device):
                raise self._gone("control lost: no heartbeat, a restart, or another program took it")
            return None
        try:
            return self._grabbed(buffer, host_ns)
        finally:
            # the next frame writes its own here, unless its leader packet is lost
            aravis("buffer_set_frame_id", buffer, 0)
            aravis("buffer_set_timestamp", buffer, 0)
            aravis("stream_push_buffer", self._arv_stream, buffer)

    def _grabbed(self, buffer: int, host_ns: int) -> Grabbed:
        aravis = self._aravis
        status = aravis("buffer_get_status", buffer)
        image, note = None, BUFFER_STATUS.get(status, f"status {status}")
        if note == "SUCCESS":
            size, pad, ignored = ctypes.c_size_t(0), ctypes.c_int(0), ctypes.c_int(0)
            start = aravis("buffer_get_data", buffer, ctypes.byref(size))
            aravis("buffer_get_image_padding", buffer, ctypes.byref(pad), ctypes.byref(ignored))
            image, note = whole_image(
                np.frombuffer(memoryview((ctypes.c_ubyte * size.value).from_address(start)), np.uint8),
                aravis("buffer_get_image_pixel_format", buffer),
                aravis("buffer_get_image_width", buffer),
                aravis("buffer_get_image_height", buffer),
                pad.value,
            )
        stamp, block = aravis("buffer_get_timestamp", buffer), aravis("buffer_get_frame_id", buffer)
        return Grabbed(
            block_id=self._blocks.unwrapped(block) if block else None,
            device_ns=stamp if stamp and self.capabilities.device_clock else None,
            host_ns=host_ns,
            exposure_ns=self._exposure_ns,
            image=image,
            note=note,
            triggers=None if image is None else self._triggers(buffer),
        )

    def _triggers(self, buffer: int) -> int | None:
        """Return the camera's count of pulses that came with a frame; None where none came."""
        if self._counter is None or not self._chunks:
            return None
        try:
            return int(self._aravis("chunk_parser_get_integer_value", self._chunks, buffer, self._counter))
        except AravisError:
            return None

    def _stop(self) -> None:
        aravis = self._aravis
        try:
            # stopping a camera that is gone would block until the library's time-out
            if aravis("gv_device_is_controller", self._device):
                aravis("camera_stop_acquisition", self._camera)
        except AravisError as error:
            if aravis("gv_device_is_controller", self._device):
                raise self._error(f"does not stop ({error})") from None
        finally:
            self._drop_stream()

    def _drop_stream(self) -> None:
        if self._arv_stream:
            if self._stream_socket is not None:
                self._stream_socket.close()
            stream, self._arv_stream = self._arv_stream, 0
            self._aravis.unref(stream)

    def _counts(self) -> Mapping[str, int]:
        if not self._arv_stream:
            return {}
        aravis, stream = self._aravis, self._arv_stream
        return merged((self._control_socket, self._stream_socket)) | {
            decoded(aravis("stream_get_info_name", stream, number)): aravis("stream_get_info_uint64", stream, number)
            for number in range(aravis("stream_get_n_infos", stream))
        }

    def _free(self) -> None:
        self._drop_stream()
        if self._chunks:
            self._aravis.unref(self._chunks)
            self._chunks = 0
        self._let_go()
