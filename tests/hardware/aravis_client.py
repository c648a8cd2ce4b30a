"""A client of GigE Vision cameras on libaravis by ctypes; it shares no line with the project's drivers."""

import ctypes as c
import ctypes.util
from dataclasses import dataclass

import numpy as np

P, S = c.c_void_p, c.c_char_p
SUCCESS = 0
NO_PACKET_SOCKET = 1
SOCKET_BYTES = 4 << 20
RETENTION_US = 20_000_000
TAIL_US = 300_000
PATIENT_MS = 300_000
"""A heartbeat that no pause of this machine outlasts."""


class _Error(c.Structure):
    _fields_ = [("domain", c.c_uint32), ("code", c.c_int), ("message", S)]


@dataclass
class Image:
    """A buffer as Aravis gave it: status 0 is success, 3 missing packets."""

    status: int
    frame_id: int
    device_ns: int
    pixels: np.ndarray


def library() -> c.CDLL:
    """Return libaravis; OSError where it is not installed."""
    return c.CDLL(ctypes.util.find_library("aravis-0.8") or "libaravis-0.8.so.0")


class Aravis:
    """The functions that are needed, with GLib's errors as RuntimeError."""

    def __init__(self) -> None:
        self.lib, self.glib, self.gobject = (library(), c.CDLL("libglib-2.0.so.0"), c.CDLL("libgobject-2.0.so.0"))
        self.gobject.g_object_unref.argtypes = [P]
        self.glib.g_error_free.argtypes = [c.POINTER(_Error)]

    def call(self, name: str, result: object, *arguments: object, fails: bool = True) -> object:
        function = getattr(self.lib, f"arv_{name}")
        function.restype = result
        if not fails:
            return function(*arguments)
        error = c.POINTER(_Error)()
        given = function(*arguments, c.byref(error))
        if error:
            text = error.contents.message.decode()
            self.glib.g_error_free(error)
            raise RuntimeError(f"{name}: {text}")
        return given

    def discovered(self) -> list[tuple[str, str]]:
        """Return (address, serial) of the cameras that answer on the network."""
        self.call("update_device_list", None, fails=False)
        count = self.call("get_n_devices", c.c_uint, fails=False)
        return [
            (
                self.call("get_device_address", S, c.c_uint(k), fails=False).decode(),
                self.call("get_device_serial_nbr", S, c.c_uint(k), fails=False).decode(),
            )
            for k in range(count)
        ]

    def unref(self, thing: int) -> None:
        self.gobject.g_object_unref(thing)


class Client:
    """One camera, opened by its address."""

    def __init__(self, address: str) -> None:
        self.aravis = Aravis()
        self.camera = P(self.aravis.call("camera_new", P, S(address.encode())))
        self.stream: P | None = None
        self.set(GevHeartbeatTimeout=PATIENT_MS)

    def _camera(self, name: str, result: object, *arguments: object) -> object:
        return self.aravis.call(f"camera_{name}", result, self.camera, *arguments)

    def set(self, **features: object) -> None:
        for name, value in features.items():
            key = S(name.encode())
            if isinstance(value, bool):
                self._camera("set_boolean", None, key, c.c_int(value))
            elif isinstance(value, int):
                self._camera("set_integer", None, key, c.c_int64(value))
            elif isinstance(value, float):
                self._camera("set_float", None, key, c.c_double(value))
            else:
                self._camera("set_string", None, key, S(str(value).encode()))

    def integer(self, name: str) -> int:
        return self._camera("get_integer", c.c_int64, S(name.encode()))

    def real(self, name: str) -> float:
        return self._camera("get_float", c.c_double, S(name.encode()))

    def text(self, name: str) -> str:
        return self._camera("get_string", S, S(name.encode())).decode()

    def execute(self, name: str) -> None:
        self._camera("execute_command", None, S(name.encode()))

    def trigger_on(self, source: str) -> None:
        self.set(TriggerSelector="FrameStart", TriggerSource=source, TriggerMode="On")

    def arm(self, buffers: int = 32, packet_bytes: int | None = 8000, retention_us: int = RETENTION_US) -> None:
        if packet_bytes is None:
            self._camera("gv_auto_packet_size", c.c_uint)
        else:
            self._camera("gv_set_packet_size", None, c.c_int(packet_bytes))
        size = self._camera("get_payload", c.c_uint)
        # root's packet sockets receive other processes' streams until their filter is set: use plain UDP
        self.aravis.call("camera_gv_set_stream_options", None, self.camera, c.c_int(NO_PACKET_SOCKET), fails=False)
        self.stream = P(self._camera("create_stream", P, None, None))
        set_property = self.aravis.gobject.g_object_set
        set_property(self.stream, S(b"socket-buffer-size"), c.c_int(SOCKET_BYTES), None)
        # a busy machine may hold a sender up for longer than the 0.1 s after which Aravis gives a frame up
        set_property(self.stream, S(b"frame-retention"), c.c_uint(retention_us), None)
        # and during a frame: unsent packets would be requested again, up to the limit
        set_property(self.stream, S(b"packet-timeout"), c.c_uint(TAIL_US), None)
        set_property(self.stream, S(b"packet-request-ratio"), c.c_double(1.0), None)
        for _ in range(buffers):
            buffer = P(self.aravis.call("buffer_new", P, c.c_size_t(size), None, fails=False))
            self.aravis.call("stream_push_buffer", None, self.stream, buffer, fails=False)
        self._camera("start_acquisition", None)

    def disarm(self) -> None:
        self._camera("stop_acquisition", None)
        if self.stream:
            self.aravis.unref(self.stream)
            self.stream = None

    def grab(self, timeout_s: float = 1.0) -> Image | None:
        call = self.aravis.call
        wait = c.c_uint64(int(timeout_s * 1e6))
        found = call("stream_timeout_pop_buffer", P, self.stream, wait, fails=False)
        if not found:
            return None
        buffer = P(found)
        status = call("buffer_get_status", c.c_int, buffer, fails=False)
        size = c.c_size_t()
        data = call("buffer_get_data", P, buffer, c.byref(size), fails=False)
        height = call("buffer_get_image_height", c.c_int, buffer, fails=False)
        width = call("buffer_get_image_width", c.c_int, buffer, fails=False)
        pixel_format = call("buffer_get_image_pixel_format", c.c_uint32, buffer, fails=False)
        kind = np.uint8 if pixel_format >> 16 & 0xFF == 8 else np.uint16
        wanted = width * height * np.dtype(kind).itemsize
        raw = (c.c_uint8 * wanted).from_address(data) if status == SUCCESS else (c.c_uint8 * 0)()
        pixels = np.frombuffer(raw, kind).copy()
        image = Image(
            status,
            call("buffer_get_frame_id", c.c_uint64, buffer, fails=False),
            call("buffer_get_timestamp", c.c_uint64, buffer, fails=False),
            pixels.reshape(height, width) if status == SUCCESS else pixels,
        )
        call("stream_push_buffer", None, self.stream, buffer, fails=False)
        return image

    def statistics(self) -> dict[str, int]:
        """Return Aravis's own counts: n_resent_packets, n_missing_packets, ..."""
        stream, found = self.stream, {}
        call = self.aravis.call
        for k in range(call("stream_get_n_infos", c.c_uint, stream, fails=False)):
            name = call("stream_get_info_name", S, stream, c.c_uint(k), fails=False).decode()
            value = call("stream_get_info_uint64", c.c_uint64, stream, c.c_uint(k), fails=False)
            found[name] = value
        return found

    def close(self) -> None:
        if self.stream:
            self.disarm()
        if self.camera:
            self.aravis.unref(self.camera)
            self.camera = P()
