"""Brightness of a lamp at a known place in the frames of a camera that may move: the sum over a window about it.

``brightness`` finds a lamp as what changes most in a still camera's images; in those of a moving camera everything
changes, but its poses determine where in the image the lamp is. The light of a lamp that shines to all sides falls
with the square of the distance, which is corrected for.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from mosca.data.arrays import Array
from mosca.data.frames import Frame, FrameSource, WrappedSource, mid_exposure_ns
from mosca.data.rig import Rig
from mosca.diagnostics.light_marker.brightness import Brightness
from mosca.diagnostics.light_marker.offsets import FlashOffset, align, edges_of
from mosca.errors import InputError
from mosca.machines.self_orientation.lamp import lamp_image

MARGIN_PX = 6.0
"""Margin around the lamp's image for its blur and for errors of the poses."""
FEWEST_FRAMES = 10


class LampWindow:
    """The brightness of a lamp, frame by frame, of one camera."""

    def __init__(self, camera: str, bit_depth: int) -> None:
        self._camera, self._full = camera, float(2**bit_depth - 1)
        self._rows: list[tuple[int, int, float, float, float]] = []

    def take(self, frame: Frame, xy_px: Array, radius_px: float, distance_m: float) -> None:
        """Measure the lamp about ``xy_px`` (2,); a frame that does not show the whole window is left out."""
        if frame.image is None or not np.isfinite([*xy_px, radius_px]).all():
            return
        half = int(np.ceil(radius_px + MARGIN_PX))
        x, y = (round(float(v)) for v in xy_px)
        if min(x, y) < half or x + half >= frame.image.shape[1] or y + half >= frame.image.shape[0]:
            return
        patch = frame.image[y - half : y + half + 1, x - half : x + half + 1].astype(float)
        rim = np.concatenate([patch[0], patch[-1], patch[1:-1, 0], patch[1:-1, -1]])
        dark = float(np.median(rim))
        start = mid_exposure_ns(frame) - frame.exposure_ns // 2
        start += round(frame.row_time_ns * (float(xy_px[1]) - (frame.rows - 1) / 2))
        light = float(patch.sum() - dark * patch.size) * distance_m**2
        self._rows.append((start, frame.exposure_ns, light, float(patch.max()) - dark, float(patch.max())))

    def brightness(self) -> Brightness:
        """Return what was measured; InputError where fewer than FEWEST_FRAMES frames show the lamp."""
        if len(self._rows) < FEWEST_FRAMES:
            raise InputError(
                f"camera '{self._camera}': the lamp's place is seen in {len(self._rows)} frames, {FEWEST_FRAMES} at "
                "least are wanted; put it beside the test field, or correct where it is said to be"
            )
        ordered = sorted(self._rows)
        start, exposure = (np.array([row[k] for row in ordered], dtype=np.int64) for k in (0, 1))
        light, change, peak = (np.array([row[k] for row in ordered]) for k in (2, 3, 4))
        return Brightness(start, exposure, light, float(change.max()), self._full, bool(peak.max() >= self._full))


class LampWatch(WrappedSource):
    """A rig's source that measures a lamp at ``xyz`` (3,) [m, world] in the frames of still cameras on the way."""

    def __init__(self, source: FrameSource, rig: Rig, xyz: Array, diameter_m: float) -> None:
        super().__init__(source)
        bits = {info.name: info.bit_depth for info in source.cameras}
        self.windows = {one.name: LampWindow(one.name, bits[one.name]) for one in rig.cameras if one.name in bits}
        self._places = {one.name: lamp_image(one, xyz, diameter_m) for one in rig.cameras}

    def __iter__(self) -> Iterator[Frame]:
        for frame in super().__iter__():
            if frame.camera in self.windows:
                self.windows[frame.camera].take(frame, *self._places[frame.camera])
            yield frame

    def best(self) -> Brightness:
        """Return the brightness in the camera that sees most of the lamp's edges; InputError where none does."""
        return most_edges(self.windows.values())


def most_edges(windows: Iterable[LampWindow]) -> Brightness:
    """Return the brightness of the window with most edges; raise the first refusal where all windows refuse."""
    found: list[tuple[int, Brightness]] = []
    refusals: list[InputError] = []
    for window in windows:
        try:
            seen = window.brightness()
            found.append((len(edges_of("rig", seen).time_s), seen))
        except InputError as refusal:
            refusals.append(refusal)
    if not found:
        raise refusals[0]
    return max(found, key=lambda one: one[0])[1]


def clock_offset(camera: str, rig: Brightness, own: Brightness) -> FlashOffset:
    """Return by how much the stamps of ``camera`` are ahead of the rig's; InputError where that is not certain."""
    return align(camera, edges_of("rig", rig), edges_of(camera, own))
