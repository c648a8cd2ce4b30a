"""Decoding of an image file to a mono image, or to the reason why it cannot be decoded.

Decoders differ in what they do with a file that was cut short: some return the part that they got. So two checks
precede OpenCV's decoding: whether a PNG, TIFF, BMP or JPEG is whole, and how much memory it would take, since a
header may state any size.

Colour is reduced to mono by one rule: luma of ITU-R BT.601, ``0.299 R + 0.587 G + 0.114 B`` rounded, as by
``cv2.COLOR_BGR2GRAY``; an alpha channel is dropped. Mono images stay as they are, 8 or 16 bit.
"""

import struct
import zlib

import cv2
import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import MOST_IMAGE_BYTES

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")
# ImageWidth, ImageLength, BitsPerSample, PhotometricInterpretation, StripOffsets, SamplesPerPixel, StripByteCounts,
# TileWidth, TileLength, TileOffsets, TileByteCounts
_TIFF_TAGS = (256, 257, 258, 262, 273, 277, 279, 322, 323, 324, 325)
# the note of its frame states what a damaged file lacks; libtiff would print it too
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
_PNG = b"\x89PNG\r\n\x1a\n"


def decode_image(data: bytes) -> tuple[Array | None, str]:
    """Return the mono image (H, W) uint8 or uint16 of a file's bytes and "", or None and what is wrong."""
    fault = what_is_missing(data)
    if fault:
        return None, fault
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        return None, f"not decodable ({error.err})"
    if image is None:
        return None, "not decodable as an image"
    if image.dtype not in (np.uint8, np.uint16):
        return None, f"{image.dtype} pixels; 8 or 16 bit unsigned wanted"
    if image.ndim == 3 and image.shape[2] == 4:
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2GRAY)
    elif image.ndim == 3 and image.shape[2] == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if image.ndim != 2:
        return None, f"{image.shape[2]} channels; 1, 3 or 4 wanted"
    return image, ""


def what_is_missing(data: bytes) -> str:
    """Return "" for a whole PNG, TIFF, BMP or JPEG file of an allowed size, else a text of what is wrong with it."""
    if not data:
        return "empty file"
    if data.startswith(_PNG):
        return _missing_in_png(data)
    if data[:2] == b"BM":
        return _missing_in_bmp(data)
    if data[:4] in (b"II*\0", b"MM\0*"):
        return _missing_in_tiff(data)
    if data[:3] == b"\xff\xd8\xff":
        return _missing_in_jpeg(data)
    return "neither PNG, TIFF, BMP nor JPEG"


def _too_large(width: int, height: int, pixel_bytes: int) -> str:
    if width * height * pixel_bytes <= MOST_IMAGE_BYTES:
        return ""
    return f"states {width}x{height} px; at most {MOST_IMAGE_BYTES // pixel_bytes} px of {pixel_bytes} bytes are read"


def _missing_in_png(data: bytes) -> str:
    """Walk the chunks (PNG specification, section 5.3): length, type, data, CRC of type and data."""
    place = len(_PNG)
    if len(data) < 26 or data[12:16] != b"IHDR":
        return "PNG cut short or damaged in its header"
    width, height, depth, colour = struct.unpack_from(">IIBB", data, 16)
    if fault := _too_large(width, height, (2 if depth == 16 else 1) * {0: 1, 2: 3}.get(colour, 4)):
        return fault
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        end = place + 8 + length
        if end + 4 > len(data):
            return f"PNG cut short at byte {len(data)}"
        if zlib.crc32(memoryview(data)[place + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            return f"PNG damaged: wrong checksum of the chunk at byte {place}"
        if data[place + 4 : place + 8] == b"IEND":
            return ""
        place = end + 4
    return f"PNG cut short at byte {len(data)}"


def _missing_in_bmp(data: bytes) -> str:
    if len(data) < 26:
        return "BMP cut short in its header"
    (declared,) = struct.unpack_from("<I", data, 2)
    width, height = struct.unpack_from("<HH" if data[14:18] == b"\x0c\0\0\0" else "<ii", data, 18)
    if fault := _too_large(abs(width), abs(height), 4):
        return fault
    return f"BMP cut short: {len(data)} of {declared} bytes" if declared > len(data) else ""


def _missing_in_jpeg(data: bytes) -> str:
    """Walk the segments up to the scan (ISO/IEC 10918-1, B.1.1): marker, length; a whole file has an end after it."""
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        kind = data[place + 1]
        (length,) = struct.unpack_from(">H", data, place + 2)
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, place + 5)
            if fault := _too_large(width, height, 4):
                return fault
        if kind == 0xDA:
            return "" if data.rfind(b"\xff\xd9", place) > 0 else f"JPEG cut short at byte {len(data)}"
        # a fill byte may precede a marker
        place += 1 if kind == 0xFF else 2 + length
    return "JPEG cut short or damaged in its header"


def _missing_in_tiff(data: bytes) -> str:
    """Check that the first image's strips or tiles lie inside the file (TIFF 6.0, section 2)."""
    order = "<" if data[:2] == b"II" else ">"
    try:
        (directory,) = struct.unpack_from(order + "I", data, 4)
        (n_entries,) = struct.unpack_from(order + "H", data, directory)
        values = {}
        for k in range(n_entries):
            tag, kind, count, _ = struct.unpack_from(order + "HHII", data, directory + 2 + 12 * k)
            if tag in _TIFF_TAGS:
                values[tag] = _tiff_values(data, order, directory + 2 + 12 * k + 8, kind, count)
    except (struct.error, KeyError):
        return f"TIFF cut short or damaged: its directory is not within its {len(data)} bytes"
    width, height, tile_width, tile_height = (max(values.get(tag, ()), default=0) for tag in (256, 257, 322, 323))
    mono = max(values.get(277, ()), default=1) == 1 and max(values.get(262, ()), default=1) <= 1
    n_bytes = -(-max(values.get(258, ()), default=8) // 8) * (1 if mono else 4)
    if fault := _too_large(width, height, n_bytes) or _too_large(tile_width, tile_height, n_bytes):
        return fault
    for offsets, sizes in ((273, 279), (324, 325)):
        if offsets in values and sizes in values:
            ends = [a + b for a, b in zip(values[offsets], values[sizes], strict=False)]
            if max(ends, default=0) > len(data):
                return f"TIFF cut short: {len(data)} of {max(ends)} bytes"
    return ""


def _tiff_values(data: bytes, order: str, place: int, kind: int, count: int) -> tuple[int, ...]:
    """Return the integers of a directory entry; up to four bytes are inline, more at the offset given."""
    code, size = {3: ("H", 2), 4: ("I", 4)}[kind]
    if count * size > 4:
        (place,) = struct.unpack_from(order + "I", data, place)
    if place + count * size > len(data):
        raise struct.error
    return struct.unpack_from(f"{order}{count}{code}", data, place)
