"""The static background of a station's images, from the first frames of its recording or of its cameras.

A rig has no earlier recording. So its first frames, as many as [background] frames, are used only for the background,
and detections begin with the next one.
"""

from collections.abc import Callable, Iterable, Mapping

from mosca.data.arrays import Array
from mosca.data.frames import Frame
from mosca.detection.detect import mean_background, minimum_background
from scenarios.commands.reconstruct import BackgroundSpec

Make = Callable[[Iterable[Array]], Array]


class Backgrounds:
    """Each camera's background, known (``ready``) or made from its first frames by the settings ``spec``.

    ``on_made`` is called once for each background that was made.
    """

    def __init__(
        self,
        spec: BackgroundSpec | None = None,
        ready: Mapping[str, Array] | None = None,
        on_made: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._known = dict(ready or {})
        self._wanted = 0 if spec is None or spec.kind == "none" or ready else spec.frames
        self._make: Make = minimum_background if spec is not None and spec.kind == "minimum" else mean_background
        self._first: dict[str, list[Array]] = {}
        self._seen: dict[str, int] = {}
        self.on_made = on_made

    def of(self, camera: str) -> Array | None:
        """Return the background subtracted from a camera's images; None for none."""
        return self._known.get(camera)

    def takes(self, frame: Frame) -> bool:
        """Return whether ``frame`` goes into its camera's background, and take it."""
        if not self._wanted or frame.camera in self._known:
            return False
        images = self._first.setdefault(frame.camera, [])
        self._seen[frame.camera] = seen = self._seen.get(frame.camera, 0) + 1
        if frame.image is not None:
            images.append(frame.image)
        if seen >= self._wanted and images:
            self._known[frame.camera] = self._make(images)
            del self._first[frame.camera]
            self.on_made(f"camera '{frame.camera}': background of its first {seen} frames; detections begin")
        return True
