"""Conversion of buffers of any pixel format to the pipeline's image: (H, W) of uint8 or uint16.

Names and codes are the Pixel Format Naming Convention's (PFNC) and GigE Vision's. Packed pixels are unpacked to
uint16 with their value in the low bits. Colours become mono:

* **Bayer mosaics**: every pixel becomes the mean of its 3 x 3 neighbourhood, weighted 1 2 1 / 2 4 2 / 1 2 1 by 16.
  At each pixel of all four mosaics this gives red / 4 + green / 2 + blue / 4, so the order of the colours does not
  matter. The image keeps its size, and the kernel is symmetric: the centroid of a marker is the centroid of
  the raw pixels, whereas a mean over 2 x 2 would shift it by half a pixel.
  Borders are mirrored without the border pixel, which keeps the colours' order.
* **Colour pixels**: luma of ITU-R BT.601, (9798 R + 19235 G + 3735 B + 16384) / 32768 in integers. YUV gives its Y.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mosca.data.arrays import Array

Packing = Literal["bytes", "p", "packed", "yuyv", "uyvy", "rgb", "bgr", "rgba", "bgra"]


@dataclass(frozen=True)
class PixelFormat:
    """A pixel format of the Pixel Format Naming Convention (PFNC)."""

    code: int
    """The format's PFNC code of 32 bits."""
    bits: int
    """Significant bits of a pixel."""
    packing: Packing
    mosaic: bool = False
    """Whether it is a Bayer mosaic."""

    @property
    def bits_in_memory(self) -> int:
        """Bits that a pixel takes in the buffer, as contained in its PFNC code."""
        return (self.code >> 16) & 0xFF


def _formats() -> dict[str, PixelFormat]:
    found = {
        "Mono8": PixelFormat(0x01080001, 8, "bytes"),
        "Mono10": PixelFormat(0x01100003, 10, "bytes"),
        "Mono10p": PixelFormat(0x010A0046, 10, "p"),
        "Mono10Packed": PixelFormat(0x010C0004, 10, "packed"),
        "Mono12": PixelFormat(0x01100005, 12, "bytes"),
        "Mono12p": PixelFormat(0x010C0047, 12, "p"),
        "Mono12Packed": PixelFormat(0x010C0006, 12, "packed"),
        "Mono16": PixelFormat(0x01100007, 16, "bytes"),
    }
    # PFNC numbers the four mosaics in one order, except for the packings of the "p" kind
    for order, colours in enumerate(("GR", "RG", "GB", "BG")):
        bayer = f"Bayer{colours}"
        found[f"{bayer}8"] = PixelFormat(0x01080008 + order, 8, "bytes", mosaic=True)
        found[f"{bayer}10"] = PixelFormat(0x0110000C + order, 10, "bytes", mosaic=True)
        found[f"{bayer}12"] = PixelFormat(0x01100010 + order, 12, "bytes", mosaic=True)
        found[f"{bayer}16"] = PixelFormat(0x0110002E + order, 16, "bytes", mosaic=True)
        found[f"{bayer}10Packed"] = PixelFormat(0x010C0026 + order, 10, "packed", mosaic=True)
        found[f"{bayer}12Packed"] = PixelFormat(0x010C002A + order, 12, "packed", mosaic=True)
    for order, colours in enumerate(("BG", "GB", "GR", "RG")):
        found[f"Bayer{colours}10p"] = PixelFormat(0x010A0052 + 2 * order, 10, "p", mosaic=True)
        found[f"Bayer{colours}12p"] = PixelFormat(0x010C0053 + 2 * order, 12, "p", mosaic=True)
    colour: tuple[tuple[int, Packing, tuple[str, ...]], ...] = (
        (0x02180014, "rgb", ("RGB8", "RGB8Packed")),
        (0x02180015, "bgr", ("BGR8", "BGR8Packed")),
        (0x02200016, "rgba", ("RGBa8", "RGBA8Packed")),
        (0x02200017, "bgra", ("BGRa8", "BGRA8Packed")),
        (0x0210001F, "uyvy", ("YUV422_8_UYVY", "YUV422Packed")),
        (0x02100032, "yuyv", ("YUV422_8", "YUV422_YUYV_Packed")),
    )
    for code, packing, names in colour:
        found.update(dict.fromkeys(names, PixelFormat(code, 8, packing)))
    return found


FORMATS = _formats()
_BY_CODE = {pixel_format.code: pixel_format for pixel_format in FORMATS.values()}


def whole_image(buffer: Array, code: int, width: int, height: int, line_padding: int = 0) -> tuple[Array | None, str]:
    """Return the mono image (height, width) in ``buffer`` and "", or None and the reason why there is none.

    ``buffer``: (n,) uint8, read and never kept; ``code``: PFNC; ``line_padding``: bytes after each line.
    """
    pixel_format = _BY_CODE.get(code)
    if pixel_format is None:
        return None, f"PIXEL_FORMAT_UNKNOWN 0x{code:08X}"
    rows, pixels = (height, width) if line_padding else (1, height * width)
    line = (pixels * pixel_format.bits_in_memory + 7) // 8
    wanted = rows * (line + line_padding)
    if buffer.size < wanted - line_padding:
        return None, f"SIZE_MISMATCH {buffer.size} of {wanted} bytes"
    if rows == 1:
        lines = buffer[:line].reshape(1, line)
    else:
        # the last line's padding may be left out
        lines = np.lib.stride_tricks.as_strided(
            buffer, shape=(rows, line), strides=(line + line_padding, 1), writeable=False
        )
    values = _values(lines, pixel_format, pixels).reshape(height, width)
    return (bayer_to_mono(values, pixel_format.bits) if pixel_format.mosaic else values), ""


def bayer_to_mono(mosaic: Array, bits: int) -> Array:
    """Return a Bayer mosaic (H, W) of ``bits`` as mono of its size and type; see the rule above."""
    # 16 times a 12-bit value, and the half that rounds, just fit into 16 bits
    framed = np.pad(mosaic.astype(np.uint16 if bits <= 12 else np.uint32), 1, mode="reflect")
    across = framed[:, 1:-1] << 1
    across += framed[:, :-2]
    across += framed[:, 2:]
    down = across[1:-1] << 1
    down += across[:-2]
    down += across[2:]
    down += 8
    down >>= 4
    return down.astype(mosaic.dtype)


def luma(red: Array, green: Array, blue: Array) -> Array:
    """Return BT.601's luma of 8-bit colours, uint8 of their shape."""
    total = red.astype(np.uint32)
    total *= 9798
    for colour, weight in ((green, 19235), (blue, 3735)):
        share = colour.astype(np.uint32)
        share *= weight
        total += share
    total += 16384
    total >>= 15
    return total.astype(np.uint8)


def _values(lines: Array, pixel_format: PixelFormat, pixels: int) -> Array:
    """Return each line's pixels, (rows, pixels), in new memory."""
    packing, bits = pixel_format.packing, pixel_format.bits
    if packing == "bytes" and bits == 8:
        return np.array(lines, order="C")
    if packing == "bytes":
        return np.ascontiguousarray(lines).view("<u2").astype(np.uint16)
    if packing in ("yuyv", "uyvy"):
        return np.array(lines[:, 0 if packing == "yuyv" else 1 :: 2], order="C")
    if packing in ("rgb", "bgr", "rgba", "bgra"):
        step = len(packing)
        red, green, blue = (lines[:, packing.index(colour) :: step] for colour in "rgb")
        return luma(red, green, blue)
    group, unpack = _UNPACKERS[(packing, bits)]
    short = -lines.shape[1] % group
    groups = np.pad(lines, ((0, 0), (0, short))).reshape(lines.shape[0], -1, group).astype(np.uint16)
    return np.ascontiguousarray(unpack(groups).reshape(lines.shape[0], -1)[:, :pixels])


def _unpack_10p(g: Array) -> Array:
    # four pixels in five bytes, least significant bit first
    return np.stack(
        (
            g[..., 0] | (g[..., 1] & 0x03) << 8,
            g[..., 1] >> 2 | (g[..., 2] & 0x0F) << 6,
            g[..., 2] >> 4 | (g[..., 3] & 0x3F) << 4,
            g[..., 3] >> 6 | g[..., 4] << 2,
        ),
        axis=-1,
    )


def _unpack_12p(g: Array) -> Array:
    # two pixels in three bytes, least significant bit first
    return np.stack((g[..., 0] | (g[..., 1] & 0x0F) << 8, g[..., 1] >> 4 | g[..., 2] << 4), axis=-1)


def _unpack_12packed(g: Array) -> Array:
    # GigE Vision: high bytes outside, the low nibbles of both pixels between them
    return np.stack((g[..., 0] << 4 | g[..., 1] & 0x0F, g[..., 2] << 4 | g[..., 1] >> 4), axis=-1)


def _unpack_10packed(g: Array) -> Array:
    return np.stack((g[..., 0] << 2 | g[..., 1] & 0x03, g[..., 2] << 2 | (g[..., 1] >> 4) & 0x03), axis=-1)


_UNPACKERS: dict[tuple[Packing, int], tuple[int, Callable[[Array], Array]]] = {
    ("p", 10): (5, _unpack_10p),
    ("p", 12): (3, _unpack_12p),
    ("packed", 12): (3, _unpack_12packed),
    ("packed", 10): (3, _unpack_10packed),
}
