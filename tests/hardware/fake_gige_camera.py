"""Aravis' own fake GigE Vision camera: ``fake_gige_camera.py ADDRESS SERIAL [PERMILLE]``; ends with its stdin.

It shows a moving ramp, (x + y + frame) modulo 255, loses PERMILLE of its packets and never sends one again.
"""

import ctypes
import sys


def main(address: str, serial: str, lost_permille: float) -> None:
    """Serve until stdin ends."""
    library = ctypes.CDLL("libaravis-0.8.so.0")
    new = library.arv_gv_fake_camera_new
    new.restype, new.argtypes = ctypes.c_void_p, [ctypes.c_char_p, ctypes.c_char_p]
    running = library.arv_gv_fake_camera_is_running
    running.argtypes = [ctypes.c_void_p]
    of = library.arv_gv_fake_camera_get_fake_camera
    of.restype, of.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    polls = library.arv_fake_camera_set_trigger_frequency
    polls.restype, polls.argtypes = None, [ctypes.c_void_p, ctypes.c_double]
    camera = new(address.encode(), serial.encode())
    if not camera or not running(camera):
        print("no camera", flush=True)
        return
    polls(of(camera), 200.0)
    if lost_permille:
        # a GValue that holds a double
        value = (ctypes.c_uint64 * 3)()
        library.g_value_init.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
        library.g_value_set_double.argtypes = [ctypes.c_void_p, ctypes.c_double]
        library.g_object_set_property.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
        library.g_value_init(value, 15 << 2)
        library.g_value_set_double(value, lost_permille / 1000.0)
        library.g_object_set_property(camera, b"gvsp-lost-ratio", value)
    print("serving", flush=True)
    sys.stdin.read()
    library.g_object_unref.argtypes = [ctypes.c_void_p]
    library.g_object_unref(camera)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]) if len(sys.argv) > 3 else 0.0)
