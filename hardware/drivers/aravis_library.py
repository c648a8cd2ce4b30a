"""libaravis-0.8 by ctypes: the calls that the gige driver needs, with GLib's errors as exceptions.

Any distribution packages this C library, so that no build and no bindings are needed. Names are the library's
without ``arv_``; https://aravisproject.github.io/aravis/ documents them.
"""

import ctypes
import functools
import logging
import os
import socket
import sys
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_double, c_int, c_int64, c_size_t, c_uint, c_uint64, c_void_p
from typing import Any

log = logging.getLogger("mosca.hardware.drivers")

# names another file than the system's libaravis
LIBRARY_VARIABLE = "MOSCA_ARAVIS"
LIBRARIES = {"darwin": "libaravis-0.8.dylib", "win32": "libaravis-0.8-0.dll"}

BUFFER_STATUS = {
    -1: "UNKNOWN",
    0: "SUCCESS",
    1: "CLEARED",
    2: "TIMEOUT",
    3: "MISSING_PACKETS",
    4: "WRONG_PACKET_ID",
    5: "SIZE_MISMATCH",
    6: "FILLING",
    7: "ABORTED",
    8: "PAYLOAD_NOT_SUPPORTED",
}
READ_ONLY, WRITE_ONLY, READ_WRITE = 0, 1, 2
PACKET_SIZE_ADJUSTMENT_NEVER = 0
NO_PACKET_SOCKET = 1
# GObject's fundamental types
G_TYPES = {"int": 6 << 2, "uint": 7 << 2, "double": 15 << 2}


def decoded(raw: bytes | None) -> str:
    """Return a text of the library, "" for none."""
    return (raw or b"").decode(errors="replace")


class AravisError(Exception):
    """An error that the library reports."""


class _GError(ctypes.Structure):
    _fields_ = [("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p)]


class _GValue(ctypes.Structure):
    _fields_ = [("type", c_size_t), ("data", c_uint64 * 2)]


# name without arv_: result, arguments, whether a GError** follows them
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...], bool]] = {
    "update_device_list": (None, (), False),
    "get_n_devices": (c_uint, (), False),
    "get_device_model": (c_char_p, (c_uint,), False),
    "get_device_serial_nbr": (c_char_p, (c_uint,), False),
    "get_device_address": (c_char_p, (c_uint,), False),
    "get_device_protocol": (c_char_p, (c_uint,), False),
    "camera_new": (c_void_p, (c_char_p,), True),
    "camera_get_device": (c_void_p, (c_void_p,), False),
    "camera_get_device_serial_number": (c_char_p, (c_void_p,), True),
    "camera_is_gv_device": (c_int, (c_void_p,), False),
    "camera_get_payload": (c_uint, (c_void_p,), True),
    "camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p), True),
    "camera_create_chunk_parser": (c_void_p, (c_void_p,), False),
    "chunk_parser_get_integer_value": (c_int64, (c_void_p, c_void_p, c_char_p), True),
    "camera_start_acquisition": (None, (c_void_p,), True),
    "camera_stop_acquisition": (None, (c_void_p,), True),
    "camera_gv_set_packet_size_adjustment": (None, (c_void_p, c_int), False),
    "camera_gv_set_stream_options": (None, (c_void_p, c_int), False),
    "gv_device_is_controller": (c_int, (c_void_p,), False),
    "gv_device_get_interface_address": (c_void_p, (c_void_p,), False),
    "gv_device_get_device_address": (c_void_p, (c_void_p,), False),
    "gv_stream_get_port": (ctypes.c_uint16, (c_void_p,), False),
    "gv_device_take_control": (c_int, (c_void_p,), True),
    "gv_device_get_timestamp_tick_frequency": (c_uint64, (c_void_p,), True),
    "device_read_register": (c_int, (c_void_p, c_uint64, POINTER(ctypes.c_uint32)), True),
    "device_write_register": (c_int, (c_void_p, c_uint64, ctypes.c_uint32), True),
    "device_get_feature": (c_void_p, (c_void_p, c_char_p), False),
    "device_get_genicam_xml": (c_void_p, (c_void_p, POINTER(c_size_t)), False),
    "device_is_feature_available": (c_int, (c_void_p, c_char_p), True),
    "device_execute_command": (None, (c_void_p, c_char_p), True),
    "device_dup_available_enumeration_feature_values_as_strings": (
        c_void_p,
        (c_void_p, c_char_p, POINTER(c_uint)),
        True,
    ),
    "gc_feature_node_get_actual_access_mode": (c_int, (c_void_p,), False),
    "stream_push_buffer": (None, (c_void_p, c_void_p), False),
    "stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64), False),
    "stream_get_n_infos": (c_uint, (c_void_p,), False),
    "stream_get_info_name": (c_char_p, (c_void_p, c_uint), False),
    "stream_get_info_uint64": (c_uint64, (c_void_p, c_uint), False),
    "buffer_new": (c_void_p, (c_size_t, c_void_p), False),
    "buffer_get_status": (c_int, (c_void_p,), False),
    "buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t)), False),
    "buffer_get_timestamp": (c_uint64, (c_void_p,), False),
    "buffer_get_frame_id": (c_uint64, (c_void_p,), False),
    "buffer_set_timestamp": (None, (c_void_p, c_uint64), False),
    "buffer_set_frame_id": (None, (c_void_p, c_uint64), False),
    "buffer_get_image_width": (c_int, (c_void_p,), False),
    "buffer_get_image_height": (c_int, (c_void_p,), False),
    "buffer_get_image_padding": (None, (c_void_p, POINTER(c_int), POINTER(c_int)), False),
    "buffer_get_image_pixel_format": (ctypes.c_uint32, (c_void_p,), False),
}
for _kind in ("enumeration", "boolean", "command", "integer", "float", "string"):
    _SIGNATURES[f"gc_{_kind}_get_type"] = (c_size_t, (), False)
for _kind, _type in (("boolean", c_int), ("integer", c_int64), ("float", c_double), ("string", c_char_p)):
    _SIGNATURES[f"device_get_{_kind}_feature_value"] = (_type, (c_void_p, c_char_p), True)
    _SIGNATURES[f"device_set_{_kind}_feature_value"] = (None, (c_void_p, c_char_p, _type), True)
    if _kind in ("integer", "float"):
        bounds = (c_void_p, c_char_p, POINTER(_type), POINTER(_type))
        _SIGNATURES[f"device_get_{_kind}_feature_bounds"] = (None, bounds, True)
        _SIGNATURES[f"device_get_{_kind}_feature_increment"] = (_type, (c_void_p, c_char_p), True)


_GLIB: dict[str, tuple[Any, ...]] = {
    "g_error_free": (c_void_p,),
    "g_free": (c_void_p,),
    "g_object_unref": (c_void_p,),
    "g_type_check_instance_is_a": (c_void_p, c_size_t),
    "g_socket_address_to_native": (c_void_p, c_void_p, c_size_t, c_void_p),
    "g_value_init": (c_void_p, c_size_t),
    "g_value_set_uint": (c_void_p, c_uint),
    "g_value_set_int": (c_void_p, c_int),
    "g_value_set_double": (c_void_p, c_double),
    "g_object_set_property": (c_void_p, c_char_p, c_void_p),
}


class Aravis:
    """The library: ``aravis("camera_new", address)`` calls ``arv_camera_new``; AravisError where it reports one."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._calls: dict[str, Callable[..., Any]] = {}
        self._glib = library
        for name, arguments in _GLIB.items():
            call = getattr(library, name)
            truth = name.endswith(("_is_a", "_to_native"))
            call.restype, call.argtypes = c_int if truth else None, arguments
        for name, (result, arguments, errs) in _SIGNATURES.items():
            call = getattr(library, f"arv_{name}")
            call.restype = result
            call.argtypes = [*arguments, *([POINTER(POINTER(_GError))] if errs else [])]
            self._calls[name] = functools.partial(self._checked, call) if errs else call

    def __call__(self, name: str, *arguments: Any) -> Any:
        """Call ``arv_<name>``."""
        return self._calls[name](*arguments)

    def _checked(self, call: Callable[..., Any], *arguments: Any) -> Any:
        error = POINTER(_GError)()
        result = call(*arguments, ctypes.byref(error))
        if error:
            message = (error.contents.message or b"no reason given").decode(errors="replace")
            self._glib.g_error_free(error)
            raise AravisError(" ".join(message.split()))
        return result

    def is_a(self, instance: int, kind: str) -> bool:
        """Whether an object is of the type that ``arv_<kind>_get_type`` returns."""
        return bool(self._glib.g_type_check_instance_is_a(instance, self(f"{kind}_get_type")))

    def set_property(self, instance: int, name: str, kind: str, value: float) -> None:
        """Set an object's property; ``kind``: uint, int (enumerations too) or double."""
        holder = _GValue()
        self._glib.g_value_init(ctypes.byref(holder), G_TYPES[kind])
        getattr(self._glib, f"g_value_set_{kind}")(ctypes.byref(holder), value)
        self._glib.g_object_set_property(instance, name.encode(), ctypes.byref(holder))

    def ipv4(self, address: int) -> str:
        """Return the IPv4 address of a GSocketAddress, "" where it is none."""
        native = (ctypes.c_ubyte * 16)()  # struct sockaddr_in: the address stands in bytes 4 to 8
        taken = address and self._glib.g_socket_address_to_native(address, native, len(native), None)
        return socket.inet_ntoa(bytes(native[4:8])) if taken else ""

    def register(self, device: int, address: int) -> int | None:
        """Return a device's register; None where it has none or refuses."""
        value = ctypes.c_uint32(0)
        try:
            self("device_read_register", device, address, ctypes.byref(value))
        except AravisError as error:
            log.debug("register 0x%04x: %s", address, error)
            return None
        return value.value

    def strings(self, name: str, *arguments: Any) -> tuple[str, ...]:
        """Return the texts of a call that fills a count and returns an array; the texts stay the library's."""
        count = c_uint(0)
        array = self(name, *arguments, ctypes.byref(count))
        if not array:
            return ()
        texts = ctypes.cast(array, POINTER(c_char_p))
        found = tuple(decoded(texts[k]) for k in range(count.value))
        self._glib.g_free(array)
        return found

    def unref(self, instance: int) -> None:
        """Release this program's reference to an object."""
        self._glib.g_object_unref(instance)


@functools.lru_cache(maxsize=1)
def _loaded(file: str) -> Aravis:
    try:
        library = ctypes.CDLL(file)
    except OSError as error:
        raise ImportError(f"{file} cannot be loaded: {error}") from None
    # GLib's own calls are found through the library's handle: dlsym searches what a library depends on
    return Aravis(library)


def load() -> Aravis:
    """Return the library; ImportError where it is not installed."""
    file = os.environ.get(LIBRARY_VARIABLE) or LIBRARIES.get(sys.platform, "libaravis-0.8.so.0")
    return _loaded(file)
