"""Buffer of frames not yet written that survives the process: slots of a file in shared memory.

While the disk or the machine is slow, frames wait in the writer's memory and are lost on ``kill -9``. A file on
/dev/shm is memory of the operating system: its content survives the process, and no disk can delay it. A slot holds a
frame uncompressed; it is reused as soon as the frame is in the recording.

The file's layout, little-endian: 8 bytes ``moscaT2\\0``, u64 size of a slot, u64 number of slots used, 16 random
bytes that the recording states too, u32 crc32 of these 40 bytes, padded to 4096; then the slots, each ::

    8 bytes ``frame\\0\\0\\0``, written last (zeros while the slot is being filled)
    u32 camera, in the recording's order, u8 status, u8 stamp event, u8 bytes a pixel, u8 1: crc32 covers pixels
    u32 height, u32 width, u32 length of the note, u32 crc32
    i64 arrival at the machine [ns] (-1: not known), i64 index, i64 time [ns], i64 exposure [ns], i64 row time [ns]
    note (UTF-8, 248 bytes at most), pixels from byte 320 of the slot on, row by row

A slot's crc32 covers the bytes from camera to the end of the note, with 0 in place of the crc32 itself. When the tail
is moved to the disk, the crc32 covers the pixels after the note, too (in memory that would take time from the
cameras). Slots that are not full are left out, and the file begins with ``moscaD2\\0``. Tails of ``mosca\\0t1`` have
neither checksums nor random bytes.

The writer locks the file (flock); a reader determines from the lock whether the writer is alive. A recording may come
from anywhere, so what it states of its tail is not trusted: a tail is read only from a regular file of the name that
``Tail`` gives, directly in /dev/shm, whose 16 bytes are the recording's. It is removed only when a copy is on disk.
"""

import hashlib
import heapq
import mmap
import os
import re
import secrets
import struct
import tempfile
import threading
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BufferedReader
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mosca.data.arrays import Array
from mosca.data.files.bounded import open_file
from mosca.data.files.whole_file import whole_file
from mosca.data.frames import CameraInfo, Frame
from mosca.errors import InputError
from mosca.recording.mcap_format import EVENTS, STATUSES

MEMORY = Path("/dev/shm")
TAIL_NAME = "recording.tail"
"""Name of a tail in the recording's folder, once it was found after its writer had been killed."""

LARGEST_TAIL = 1 << 29
"""Largest size of all slots [B]: as much as a writer keeps."""
NO_TOKEN = bytes(16)
"""Token of a tail, and assumed token of its recording, where neither has one (before version 0.3)."""

_NAME = re.compile(r"mosca-[A-Za-z0-9_]+\.tail")
_MAGIC, _ON_DISK, _OLDER = b"moscaT2\0", b"moscaD2\0", b"mosca\0t1"
_FULL, _EMPTY = b"frame\0\0\0", bytes(8)
_FILE = struct.Struct("<8sQQ16s")
_SLOT = struct.Struct("<IBBBBIIIIqqqqq")
_NOTE_AT, _NOTE_BYTES, _PIXELS_AT, _PAGE = 72, 248, 320, 4096
_COVERS_PIXELS_AT, _SUM_AT = 15, 28
_SUM = struct.Struct("<I")


@dataclass(frozen=True, eq=False)
class Kept:
    """A frame of a tail; ``host_ns``: its arrival at the machine [ns], None where that was not known."""

    frame: Frame
    host_ns: int | None


class Tail:
    """Buffer for waiting frames of ``cameras``, ``most_bytes`` of memory at most, never above ``LARGEST_TAIL``.

    Raises OSError where this system has no such memory, or none is left.
    """

    def __init__(self, cameras: Sequence[CameraInfo], most_bytes: int, folder: Path = MEMORY) -> None:
        import fcntl  # where there is /dev/shm, there is flock

        largest = max(info.image_bytes for info in cameras)
        self._size = -(-(_PIXELS_AT + largest) // _PAGE) * _PAGE
        self._cameras = {info.name: number for number, info in enumerate(cameras)}
        self._most = max(min(most_bytes, LARGEST_TAIL) // self._size, 1)
        self.token = secrets.token_bytes(len(NO_TOKEN))
        self._guard = threading.Lock()
        self._free: list[int] = []
        self._used = 0
        file, name = tempfile.mkstemp(prefix="mosca-", suffix=".tail", dir=folder)
        self.path = Path(name)
        self._file = file
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.truncate(file, _PAGE + self._most * self._size)  # takes memory only where something is written
            os.posix_fallocate(file, 0, _PAGE)
            self._memory = mmap.mmap(file, 0)
            self._tell_used()
        except (OSError, ValueError):
            os.close(file)
            self.path.unlink()
            raise

    def put(self, frame: Frame, host_ns: int | None, slot: int | None = None) -> int | None:
        """Copy ``frame`` into a slot and return its number; None where all are taken or memory is exhausted.

        ``slot``: where ``reserve`` put the frame's image before.
        """
        with self._guard:
            if slot is None:
                slot = self._filled(frame.image)
            if slot is not None and self._file >= 0:
                self._tell(slot, frame, host_ns)
            return slot

    def reserve(self, image: Array) -> int | None:
        """Copy the image of a frame that is not known yet into a slot, as ``put`` would."""
        with self._guard:
            return self._filled(image)

    def free(self, slot: int) -> None:
        """Free ``slot``: its frame is in the recording."""
        with self._guard:
            heapq.heappush(self._free, slot)

    def close(self) -> None:
        """Give the memory back; may be called twice."""
        with self._guard:
            if self._file >= 0:
                self._memory.close()
                os.close(self._file)
                self._file = -1
                self.path.unlink(missing_ok=True)

    def _filled(self, image: Array | None) -> int | None:
        slot = self._taken()
        if slot is not None:
            begin = _PAGE + slot * self._size
            self._memory[begin : begin + len(_EMPTY)] = _EMPTY
            if image is not None:
                # copied without releasing the interpreter, which other threads would hold for milliseconds
                pixels = memoryview(np.ascontiguousarray(image, image.dtype.newbyteorder("<")).data).cast("B")
                self._memory[begin + _PIXELS_AT : begin + _PIXELS_AT + len(pixels)] = pixels
        return slot

    def _tell(self, slot: int, frame: Frame, host_ns: int | None) -> None:
        begin = _PAGE + slot * self._size
        note = frame.note.encode("utf-8")[:_NOTE_BYTES]
        height, width = (0, 0) if frame.image is None else frame.image.shape
        header = _SLOT.pack(
            self._cameras[frame.camera],
            STATUSES.index(frame.status),
            EVENTS.index(frame.stamp_event),
            0 if frame.image is None else frame.image.dtype.itemsize,
            0,
            height,
            width,
            len(note),
            0,
            -1 if host_ns is None else host_ns,
            frame.index,
            frame.time_ns,
            frame.exposure_ns,
            frame.row_time_ns,
        )
        self._memory[begin + len(_FULL) : begin + _NOTE_AT + len(note)] = header + note
        self._memory[begin + _SUM_AT : begin + _SUM_AT + _SUM.size] = _SUM.pack(zlib.crc32(header + note))
        self._memory[begin : begin + len(_FULL)] = _FULL

    def _taken(self) -> int | None:
        """Return a slot that is free and has its memory; None where there is none."""
        if self._file < 0:
            return None
        if self._free:
            return heapq.heappop(self._free)
        if self._used == self._most:
            return None
        try:
            # writing to a mapped page that the system has no memory for would end the process
            os.posix_fallocate(self._file, _PAGE + self._used * self._size, self._size)
        except OSError:
            return None
        self._used += 1
        self._tell_used()
        return self._used - 1

    def _tell_used(self) -> None:
        self._memory[: _FILE.size + _SUM.size] = _head(_MAGIC, self._size, self._used, self.token)


def rescued(part: Path, in_memory: Path, token: bytes) -> Path | None:
    """Return where the tail of an unfinished recording can be read; None where there is none, or its writer lives.

    ``part``: the unfinished ``recording.mcap.part``; ``in_memory``, ``token``: what it states of its tail. A tail in
    memory, which a reboot would erase, is moved beside ``part`` where possible. A file that is no tail of this
    recording is left as it is.
    """
    beside = part.parent / TAIL_NAME
    if os.path.lexists(beside):
        return beside
    # elsewhere it may be any file of the user's
    if in_memory.parent != MEMORY or not _NAME.fullmatch(in_memory.name):
        return None
    try:
        file = open_file(in_memory, links=False)
    except OSError:  # no longer there, or none of ours
        return None
    with file:
        shape = _shape(file)
        if not shape.size or shape.token != token or not _left_behind(file):
            return None
        try:
            _copy(file, shape, beside)
        except (OSError, InputError):  # a full or closed disk: it is read where it is
            return in_memory
        if os.path.samestat(os.fstat(file.fileno()), os.lstat(in_memory)):
            in_memory.unlink()
    return beside


class _Shape(NamedTuple):
    """What the head of a tail states."""

    magic: bytes
    size: int
    """Size of a slot [bytes]; 0 where the file is no tail."""
    used: int
    """Number of slots, as many as the file can hold."""
    stated: int
    """Number of slots that the head states."""
    token: bytes


def _copy(file: BufferedReader, shape: _Shape, path: Path) -> None:
    """Copy the full slots of a tail to ``path``, with checksums of their pixels.

    Raises OSError where the copy is not on the disk afterwards, or reads back differently.
    """
    older = shape.magic == _OLDER
    full = [k for k in range(shape.used) if older or _slot(file, shape, k, len(_FULL)) == _FULL]
    head = _head(_OLDER if older else _ON_DISK, shape.size, len(full), shape.token).ljust(_PAGE, b"\0")
    slots = (_slot(file, shape, k, shape.size) for k in full)
    wanted = hashlib.sha256()
    with whole_file(path) as temporary:
        with open(temporary, "wb") as copy:
            for block in chain([head], slots if older else map(_summed, slots)):
                wanted.update(block)
                copy.write(block)
            copy.flush()
            os.fsync(copy.fileno())
        with open_file(temporary) as again:
            if hashlib.file_digest(again, "sha256").digest() != wanted.digest():
                raise OSError(f"{temporary}: reads back otherwise than it was written")
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # so that the file's name is on the disk, too
    finally:
        os.close(folder)


def _slot(file: BufferedReader, shape: _Shape, k: int, n_bytes: int) -> bytes:
    file.seek(_PAGE + k * shape.size)
    return file.read(n_bytes)


def _head(magic: bytes, size: int, used: int, token: bytes) -> bytes:
    head = _FILE.pack(magic, size, used, token)
    return head if magic == _OLDER else head + _SUM.pack(zlib.crc32(head))


def read_tail(
    path: Path, cameras: Sequence[CameraInfo], note: Callable[[str], None] = lambda text: None
) -> list[Kept]:
    """Return the frames of a tail, in order of time; slots that are not whole are left out.

    ``note`` is called with a text of what was damaged. Raises InputError where ``path`` is no regular file, or larger
    than a tail can be.
    """
    kept: dict[tuple[str, int], Kept] = {}
    damaged = 0
    try:
        with open_file(path, _PAGE + LARGEST_TAIL, links=False) as file:
            shape = _shape(file)
            used = shape.used if shape.size <= _PIXELS_AT + max(info.image_bytes for info in cameras) + _PAGE else 0
            if shape.stated > shape.used:
                note(f"{path}: cut short: {shape.used} of the {shape.stated} frames that waited in it are there")
            if not shape.size or used < shape.used:
                note(f"{path}: its head is damaged; frames that waited in it are lost")
            for k in range(used):
                slot = _slot(file, shape, k, shape.size)
                one = _kept(slot, cameras, shape.magic != _OLDER)
                if one is not None and (one.frame.camera, one.frame.index) not in kept:
                    kept[one.frame.camera, one.frame.index] = one
                elif slot[:8] != _EMPTY or shape.magic == _ON_DISK:
                    damaged += 1
    except OSError as error:
        raise InputError(
            f"{path}: the frames that waited cannot be read: {error.strerror}; move it out of the folder to read the "
            "recording without them"
        ) from None
    if damaged:
        note(f"{path}: {damaged} of {used} frames that waited in it are damaged and left out")
    return sorted(kept.values(), key=lambda one: one.frame.time_ns)


def _shape(file: BufferedReader) -> _Shape:
    """Return what the head of ``file`` states, as far as the file can hold it; a size of 0 where it is no tail."""
    none = _Shape(b"", 0, 0, 0, NO_TOKEN)
    head, n_bytes = file.read(_PAGE), os.fstat(file.fileno()).st_size
    if len(head) < _PAGE:
        return none
    magic, size, used, token = _FILE.unpack_from(head)
    whole = magic in (_MAGIC, _ON_DISK) and _SUM.unpack_from(head, _FILE.size)[0] == zlib.crc32(head[: _FILE.size])
    if not (whole or magic == _OLDER) or not _PIXELS_AT <= size <= LARGEST_TAIL:
        return none
    return _Shape(magic, size, min(used, (min(n_bytes, _PAGE + LARGEST_TAIL) - _PAGE) // size), used, token)


def _sum(slot: bytes) -> int | None:
    """Return the checksum that a full slot should have; None where its header cannot be one."""
    _, _, _, pixel, covers_pixels, height, width, n_note, *_ = _SLOT.unpack_from(slot, 8)
    if n_note > _NOTE_BYTES or len(slot) < _PIXELS_AT + height * width * pixel:
        return None
    total = zlib.crc32(slot[_SUM_AT + _SUM.size : _NOTE_AT + n_note], zlib.crc32(slot[8:_SUM_AT] + bytes(_SUM.size)))
    if not covers_pixels:
        return total
    return zlib.crc32(memoryview(slot)[_PIXELS_AT : _PIXELS_AT + height * width * pixel], total)


def _is_whole(slot: bytes) -> bool:
    """Return whether a slot is full and as it was written."""
    return len(slot) >= _PIXELS_AT and slot[:8] == _FULL and _sum(slot) == _SUM.unpack_from(slot, _SUM_AT)[0]


def _summed(slot: bytes) -> bytes:
    """Return a slot with a checksum that covers its pixels."""
    if not _is_whole(slot):
        return slot
    new = bytearray(slot)
    new[_COVERS_PIXELS_AT] = 1
    _SUM.pack_into(new, _SUM_AT, _sum(bytes(new)) or 0)
    return bytes(new)


def _kept(slot: bytes, cameras: Sequence[CameraInfo], has_sums: bool) -> Kept | None:
    if len(slot) < _NOTE_AT or slot[:8] != _FULL or (has_sums and not _is_whole(slot)):
        return None
    (camera, status, event, pixel, _, height, width, n_note, _, host_ns, index, time_ns, exposure_ns, row_ns) = (
        _SLOT.unpack_from(slot, 8)
    )
    if camera >= len(cameras) or status >= len(STATUSES) or event >= len(EVENTS) or n_note > _NOTE_BYTES:
        return None
    info, image = cameras[camera], None
    if STATUSES[status] == "ok":
        n = height * width * pixel
        if (height, width) != (info.height, info.width) or pixel not in (1, 2) or len(slot) < _PIXELS_AT + n:
            return None
        dtype = np.dtype("<u2" if pixel == 2 else "u1")
        image = np.frombuffer(slot, dtype, height * width, _PIXELS_AT).reshape(height, width)
        image = image.astype(np.uint16 if pixel == 2 else np.uint8)
    note = slot[_NOTE_AT : _NOTE_AT + n_note].decode("utf-8", errors="replace")
    frame = Frame(info.name, index, time_ns, exposure_ns, image, STATUSES[status], EVENTS[event], row_ns, note)
    return Kept(frame, None if host_ns < 0 else host_ns)


def _left_behind(file: BufferedReader) -> bool:
    """Return whether the process that wrote the tail ``file`` has ended; the lock is then ours until it is closed."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (ImportError, OSError):
        return False
    return True
