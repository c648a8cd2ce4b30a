"""Faults that are planted in the frames and labels of a take because the cameras have no key for them."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from mosca.data.frames import Frame, FrameSource, WrappedSource
from mosca.data.tracks import Tracks
from scenarios.spec.clinic import BlurSpec, ClinicSpec, DropSpec, SwappedSpec


class PlantedSource(WrappedSource):
    """A source with the faults of ``[clinic]`` in its frames."""

    def __init__(self, source: FrameSource, spec: ClinicSpec) -> None:
        super().__init__(source)
        self._spec = spec
        self._rate_hz = source.cameras[0].frame_rate_hz

    def __iter__(self) -> Iterator[Frame]:
        drop, blur = self._spec.drop, self._spec.blur
        for given in self._source:
            frame: Frame | None = given
            if drop is not None and given.camera == drop.camera:
                frame = dropped(given, drop, self._rate_hz)
            if frame is not None and blur is not None and given.camera == blur.camera:
                frame = blurred(frame, blur)
            if frame is not None:
                yield frame


def dropped(frame: Frame, spec: DropSpec, rate_hz: float) -> Frame | None:
    """Return the frame with the number and stamp of a count that ignores lost frames; None where it is lost."""
    first = round(spec.at_s * rate_hz)
    if frame.index < first:
        return frame
    if frame.index < first + spec.frames:
        return None
    earlier = round(spec.frames * 1e9 / rate_hz)
    return replace(frame, index=frame.index - spec.frames, time_ns=frame.time_ns - earlier)


def blurred(frame: Frame, spec: BlurSpec) -> Frame:
    """Return the frame blurred by a Gaussian that grows with time from the session's start."""
    if frame.image is None:
        return frame
    sigma = spec.px_per_s * 1e-9 * frame.time_ns
    image = np.rint(gaussian_filter(frame.image.astype(np.float32), sigma)).astype(frame.image.dtype)
    return replace(frame, image=image)


def swapped(tracks: Tracks, spec: SwappedSpec, rate_hz: float) -> Tracks:
    """Return tracks labelled m1, m2 ..., or d1:m1 ... d2:m3, with their first two labels or bodies exchanged."""
    names, counts = np.unique(tracks.track, return_counts=True)
    longest = sorted(names[np.argsort(-counts, kind="stable")][:6].tolist())
    fewest = 6 if spec.what == "bodies" else 2
    if len(longest) < fewest:
        return tracks
    labels = (
        [f"d{1 + k // 3}:m{1 + k % 3}" for k in range(6)]
        if spec.what == "bodies"
        else [f"m{k + 1}" for k in range(6)]
    )
    of = dict(zip(longest, labels, strict=False))
    pairs = [(labels[k], labels[k + 3]) for k in range(3)] if spec.what == "bodies" else [(labels[0], labels[1])]
    other = {a: b for pair in pairs for a, b in (pair, pair[::-1])}
    first = round(spec.at_s * rate_hz)
    label = [
        other.get(of.get(track, ""), of.get(track, "")) if frame >= first else of.get(track, "")
        for track, frame in zip(tracks.track.tolist(), tracks.frame.tolist(), strict=True)
    ]
    return replace(tracks, label=np.array(label, np.str_))
