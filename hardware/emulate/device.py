"""One device on the network: an emulated camera, its two channels, and the thread that sends its exposures."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from threading import Event, Thread

import numpy as np

from hardware.emulate.acquisition import SECOND, Shot
from hardware.emulate.camera import EmulatedCamera
from hardware.emulate.control import Control, control_sockets
from hardware.emulate.faults import FAULTLESS, Faults, Luck
from hardware.emulate.gvsp import Layout, image_packets
from hardware.emulate.identity import Identity
from hardware.emulate.standard import PIXEL_FORMATS
from hardware.emulate.stream import Stream
from mosca.data.arrays import Array
from mosca.data.frames import Frame

IDLE_S = 0.5


class Device:
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
        luck = Luck(faults, identity.serial)
        self._frames = frames
        sockets = control_sockets(identity)
        self._stream = Stream(str(identity.address.ip), luck)
        self.camera = EmulatedCamera(identity, self._stream, faults, luck, first_block)
        self._control = Control(self.camera, self._stream, sockets)
        self._stop = Event()
        self._images: Counter[str] = Counter()
        self._thread = Thread(target=self._run, name=f"gvsp {identity.name}", daemon=True)
        self._thread.start()

    @property
    def identity(self) -> Identity:
        """Who the device is."""
        return self.camera.identity

    def counts(self) -> Mapping[str, int]:
        """Return what became of triggers, images and packets until now."""
        return {**self.camera.counts, **self._images, **self._stream.counts}

    def close(self) -> None:
        """Leave the network; may be called twice."""
        if self._stop.is_set():
            return
        self._stop.set()
        with self.camera.changed:
            self.camera.changed.notify_all()
        self._thread.join()
        self._control.close()
        self._stream.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            with self.camera.changed:
                found = self.camera.next_shot()
                if not isinstance(found, Shot):
                    self.camera.changed.wait(IDLE_S if found is None else min(found, IDLE_S))
                    continue
            self._take(found)

    def _take(self, shot: Shot) -> None:
        """Wait until the image is read out and send it, unless something came between."""
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
        # what the source has as damaged arrives damaged: its end is missing and is not to be had again
        packets = packets if frame.status == "ok" else packets[:-1]
        self._images["frames" if frame.status == "ok" else "corrupt"] += 1
        self._stream.send(shot.block, packets, to)


def pixels_of(frame: Frame, layout: Layout, depth: int) -> Array:
    """Return the part of ``frame``'s image that ``layout`` asks for, in its format.

    ``depth``: significant bits of the source's pixels; as Mono8 the highest eight of them. A damaged frame has no
    image: what arrives of it is dark.
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
