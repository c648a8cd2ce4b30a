"""TwinSource: a FrameSource whose cameras look at a scene, and the truth of what they looked at."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock, local

import numpy as np

from mosca.data.arrays import Array
from mosca.data.frames import CameraInfo, Frame
from mosca.data.truth import Truth
from twin.cameras.camera import VirtualCamera
from twin.cameras.kernel import gaussian_kernel
from twin.cameras.lens import TwinLens
from twin.cameras.mount import shaken_pose
from twin.cameras.occlusion import occluders_of
from twin.cameras.render import BALL, FLAT, MarkersInCamera, MeshRays, Seen, has_meshes, render_markers
from twin.cameras.sensor import dark_table, expose
from twin.cameras.shutter import Exposure, open_shutter, pulse_time_s
from twin.scenes.scene import Scene, SceneSampler
from twin.streams import key

LOOK_AHEAD = 4
"""Pulses in work for each worker: enough to keep it busy, few enough to leave early without waste."""


@dataclass(frozen=True, eq=False)
class _PulseTruth:
    xyz: Array
    seen: tuple[Seen, ...]
    exposures: tuple[Exposure, ...]


class _Reading:
    """One iteration over a source: its workers, and the truth of the pulses it has handed out."""

    def __init__(self, workers: int) -> None:
        self.truth: list[_PulseTruth] = []
        self.closed = False
        self._pool = ThreadPoolExecutor(workers)
        self._lock = Lock()

    def submit(
        self, work: "Callable[[int], tuple[list[Frame], _PulseTruth]]", pulse: int
    ) -> "Future[tuple[list[Frame], _PulseTruth]] | None":
        """Hand a pulse to the workers; None after ``close``."""
        with self._lock:
            return None if self.closed else self._pool.submit(work, pulse)

    def close(self) -> None:
        """Drop what has not begun and wait for the rest; may be called from any thread, and again."""
        with self._lock:
            self.closed = True
        self._pool.shutdown(cancel_futures=True)


class TwinSource:
    """Exposes ``scene`` through ``cameras`` at ``frame_rate_hz`` from pulse 0, ``pulses`` times.

    ``exposure_s``: the window of every exposure [s]. Same seed, same bytes: over runs, processes and numbers
    of ``workers`` (threads), because each pulse draws from streams of its own.
    Each iteration starts anew with workers of its own; ``close`` ends those under way. ``truth()`` tells what
    really was at the pulses that the iteration started last has read.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: tuple[VirtualCamera, ...],
        *,
        frame_rate_hz: float,
        exposure_s: float,
        pulses: int,
        seed: int,
        workers: int = 1,
    ) -> None:
        self.scene, self.virtual, self.pulses, self.seed = scene, tuple(cameras), pulses, seed
        self.frame_rate_hz, self.exposure_s, self.workers = frame_rate_hz, exposure_s, max(1, workers)
        self._lenses = tuple(
            TwinLens.of(v.camera.lens, v.camera.width, v.camera.height, v.optics.gap_px).vector
            for v in self.virtual
        )
        self._kernels = tuple(gaussian_kernel(v.optics.psf_sigma_px) for v in self.virtual)
        self._dark = tuple(dark_table(v.sensor) for v in self.virtual)
        self._occluders = occluders_of(scene)
        geoms = list(scene.marker_geoms)
        sphere = scene.model.geom_type[geoms] == 2
        self._shape = np.where(sphere, BALL, FLAT).astype(np.int64)
        self._radius = np.ascontiguousarray(scene.model.geom_size[geoms, 0], dtype=float)
        self._thread = local()
        self._latest: list[_PulseTruth] = []
        self._readings: set[_Reading] = set()

    @property
    def cameras(self) -> tuple[CameraInfo, ...]:
        """What each camera says of itself."""
        return tuple(
            CameraInfo(v.camera.name, v.camera.width, v.camera.height, v.sensor.bits, self.frame_rate_hz)
            for v in self.virtual
        )

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames pulse by pulse, in the rig's order; starts anew each time, ends when closed."""
        reading = _Reading(self.workers)
        self._latest = reading.truth
        self._readings.add(reading)
        waiting: deque[Future[tuple[list[Frame], _PulseTruth]]] = deque()
        try:
            for pulse in range(self.pulses + self.workers * LOOK_AHEAD):
                if pulse < self.pulses:
                    future = reading.submit(self._expose_pulse, pulse)
                    if future is None:
                        return
                    waiting.append(future)
                if waiting and (len(waiting) > self.workers * LOOK_AHEAD or pulse >= self.pulses - 1):
                    try:
                        frames, truth = waiting.popleft().result()
                    except CancelledError:  # by ``close``, from another thread
                        return
                    reading.truth.append(truth)
                    for frame in frames:
                        yield frame
                        if reading.closed:
                            return
        finally:
            reading.close()
            self._readings.discard(reading)

    def close(self) -> None:
        """Stop the workers; iterations under way end with the frame they have given last."""
        for reading in tuple(self._readings):
            reading.close()

    def __enter__(self) -> "TwinSource":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    @property
    def truth_xyz(self) -> list[Array]:
        """True marker positions (m, 3) of the pulses read so far [m]."""
        return [p.xyz for p in self._latest]

    def truth(self) -> Truth:
        """Return what really was at the pulses read so far."""
        done = self._latest
        pulse_ns = [
            round((pulse_time_s(k, self.frame_rate_hz) + self.exposure_s / 2) * 1e9) for k in range(len(done))
        ]
        m, c = len(self.scene.marker_names), len(self.virtual)
        return Truth(
            time_ns=np.array(pulse_ns, dtype=np.int64),
            names=self.scene.marker_names,
            xyz=np.array([p.xyz for p in done]).reshape(-1, m, 3),
            visible=_stack(done, "visible", (m, c)),
            cameras=tuple(v.camera.name for v in self.virtual),
            image_xy_px=_stack(done, "xy_px", (m, c, 2)),
            diameter_px=_stack(done, "diameter_px", (m, c)),
            exposure_mid_ns=np.array(
                [[round(e.middle_s * 1e9) for e in p.exposures] for p in done], dtype=np.int64
            ).reshape(-1, c),
        )

    def _sampler(self) -> SceneSampler:
        if not hasattr(self._thread, "sampler"):
            self._thread.sampler = self.scene.sampler()
        sampler: SceneSampler = self._thread.sampler
        return sampler

    def _expose_pulse(self, pulse: int) -> tuple[list[Frame], _PulseTruth]:
        """Expose every camera at one pulse: shutter, mount, lens and light, sensor, stamp."""
        sampler = self._sampler()
        frames, seen, exposures = [], [], []
        for number, virtual in enumerate(self.virtual):
            name = virtual.camera.name
            exposure = open_shutter(
                virtual.timing, name, pulse, self.frame_rate_hz, self.exposure_s, self.seed
            )
            light, what = self._collect(sampler, number, pulse, exposure)
            counts = expose(
                light, virtual.sensor, key(self.seed, f"camera/{name}/sensor", pulse), self._dark[number]
            )
            frames.append(Frame(name, pulse, exposure.stamp_ns, round(self.exposure_s * 1e9), counts))
            seen.append(what)
            exposures.append(exposure)
        middle = pulse_time_s(pulse, self.frame_rate_hz) + self.exposure_s / 2
        return frames, _PulseTruth(sampler.at(middle).marker_xyz, tuple(seen), tuple(exposures))

    def _collect(
        self, sampler: SceneSampler, number: int, pulse: int, exposure: Exposure
    ) -> tuple[Array, Seen]:
        """Return the markers' light on a camera's pixels (H, W) [electrons], and what it saw of them."""
        virtual, lens = self.virtual[number], self._lenses[number]
        camera = virtual.camera
        pose = shaken_pose(virtual.mount, camera.name, camera.world_from_camera, lens, pulse, self.seed)
        rotation, position = pose.rotation, pose.translation
        first, last = sampler.at(exposure.start_s).marker_xyz, sampler.at(exposure.end_s).marker_xyz
        state = sampler.at(exposure.middle_s)  # last, so that the sampler's data stands at mid-exposure
        path = (np.stack([first, state.marker_xyz, last], axis=1) - position) @ rotation
        electrons = virtual.marker_signal * virtual.sensor.full_well_e
        markers = MarkersInCamera(
            np.ascontiguousarray(path),
            np.ascontiguousarray(state.marker_axis @ rotation),
            self._radius,
            self._shape,
            np.full(len(path), electrons),
        )
        solid = self._occluders.geom
        mesh_rays = None
        if has_meshes(self._occluders):
            mesh_rays = MeshRays(
                self.scene.model, sampler.data, self._occluders, self.scene.marker_geoms, (rotation, position)
            )
        light = np.zeros((virtual.camera.height, virtual.camera.width), dtype=np.float32)
        seen = render_markers(
            light,
            lens,
            self._kernels[number],
            markers,
            self._occluders,
            np.ascontiguousarray((state.geom_xyz[solid] - position) @ rotation),
            np.ascontiguousarray(rotation.T @ state.geom_rotation[solid]),
            mesh_rays,
        )
        return light, seen


def _stack(done: list[_PulseTruth], name: str, shape: tuple[int, ...]) -> Array:
    """Return one quantity of Seen as (pulses, markers, cameras, ...)."""
    if not done:
        return np.empty((0, *shape))
    return np.array([np.stack([getattr(s, name) for s in p.seen], axis=1) for p in done])
