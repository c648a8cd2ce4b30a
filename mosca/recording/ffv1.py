"""Checksums of the slices of an FFV1 packet: FFmpeg's decoder shows damaged slices as good images.

From version 3 on (RFC 9043, sections 4.3 and 4.9) a stream has a configuration record, whose checksum FFmpeg does
check, and a packet is a row of slices. Each slice ends with its size (24 bit), a status byte and a CRC-32 (polynomial
0x04C11DB7, from 0 on) that makes the remainder of the whole slice 0. An encoder set to ``-slicecrc 0`` leaves out
status and CRC.
"""

import zlib

_SIZE, _FOOTER = 3, 8
"""Bytes behind a slice, without a checksum and with it."""
_MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_FROM_ZERO = 0xFFFFFFFF
"""Start value that cancels zlib's convention of beginning with all bits set and inverting the result."""


def whole_slices(packet: bytes) -> int:
    """Return the number of slices in a packet where all have good checksums; 0 for other packets."""
    slices = _slices(packet, _FOOTER)
    # zlib takes the bits of a byte in the opposite order
    good = all(zlib.crc32(one.translate(_MIRRORED), _FROM_ZERO) == _FROM_ZERO for one in slices)
    return len(slices) if good else 0


def is_without_sums(packet: bytes) -> bool:
    """Return whether a packet is a row of slices without checksums."""
    return bool(_slices(packet, _SIZE))


def _slices(packet: bytes, footer: int) -> list[bytes]:
    """Return the slices with their footers, the last one first; none where their sizes do not fill the packet."""
    slices, end = [], len(packet)
    while end > 0:
        begin = end - footer - int.from_bytes(packet[max(end - footer, 0) :][:_SIZE], "big")
        if begin < 0:
            return []
        slices.append(packet[begin:end])
        end = begin
    return slices
