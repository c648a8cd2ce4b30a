"""Are the slices of an FFV1 packet as they were written? FFmpeg's decoder shows damaged ones as good images.

From version 3 on (RFC 9043, sections 4.3 and 4.9) a stream has a configuration record, whose checksum FFmpeg does
check, and a packet is a row of slices. Each slice ends with its size (24 bit), a status byte and a CRC-32 (polynomial
0x04C11DB7, from 0 on) that makes the remainder of the whole slice 0. Status and CRC are left out where the encoder
was told to (``-slicecrc 0``).
"""

import zlib

_SIZE, _FOOTER = 3, 8
"""Bytes behind a slice, without a checksum and with it."""
_MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_FROM_ZERO = 0xFFFFFFFF
"""Undoes that zlib begins with all bits set and inverts the result."""


def whole_slices(packet: bytes) -> int:
    """Return of how many slices a packet is a row, all with good checksums; 0 for other packets."""
    slices = _slices(packet, _FOOTER)
    # zlib takes the bits of a byte from the other end
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
