"""TwinSource: a FrameSource of virtual cameras before a scene, and its truth."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Lock, local

import numpy as np

from mosca.data.arrays import Array
from mosca.data.frames import CameraInfo, Frame
from mosca.data.truth import Truth
from mosca.errors import InputError
from twin.cameras.camera_session import CameraSession, TrueExposure
from twin.cameras.delivery import Delivery, Taken, deliver
from twin.cameras.expected_image import STEP_PX, Expected, expected_frame
from twin.cameras.exposure.scene_sampling import SceneSamples
from twin.cameras.exposure.shutter import pulse_time_s
from twin.cameras.optics.lens import moved
from twin.cameras.stray_light.stray import Surroundings
from twin.cameras.stray_light.surroundings import StrayLight
from twin.cameras.subject import Subject
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.scene import Scene, SceneSampler
from twin.truth_log import PulseLog, truth_of

LOOK_AHEAD = 4
"""Default number of pulses queued for each worker: enough to keep it busy, few enough to stop without waste."""


@dataclass(frozen=True, eq=False)
class _Period:
    """The frames that the cameras took from one pulse until the next, in the order of the exposures."""

    taken: tuple[Taken, ...]
    log: PulseLog


class _Reading:
    """One iteration over a source: its workers, and the log of the pulses it has yielded."""

    def __init__(self, workers: int) -> None:
        self.log: list[PulseLog] = []
        self.closed = False
        self._pool = ThreadPoolExecutor(workers)
        self._lock = Lock()

    def submit(self, work: Callable[[int], _Period], pulse: int) -> Future[_Period] | None:
        """Submit a pulse to the workers; None after ``close``."""
        with self._lock:
            return None if self.closed else self._pool.submit(work, pulse)

    def close(self) -> None:
        """Drop work that has not begun and wait for the rest; may be called from any thread, and repeatedly."""
        with self._lock:
            self.closed = True
        self._pool.shutdown(cancel_futures=True)


class TwinSource:
    """Exposes a scene through virtual cameras at the pulses of a trigger.

    The same seed gives the same bytes in all runs and processes and for any number of ``workers`` (threads), because
    each frame draws from streams of its own. Each iteration starts anew with workers of its own; ``close`` ends
    iterations in progress. ``truth()`` returns the true state at the pulses that the last started iteration has read.
    Raises InputError for impossible cameras.

    Parameters
    ----------
    scene
        The scene that is filmed.
    cameras
        The cameras. A triggered one takes one frame per pulse, a free-running one all that fall between two pulses.
    frame_rate_hz, pulses
        Rate of the trigger and number of its pulses, from pulse 0.
    exposure_s
        Length of every exposure, except for cameras with an exposure of their own.
    seed
        Seed of all random numbers.
    workers
        Threads that render.
    deliveries
        Camera name -> faults of its frames' delivery; a camera that is not named delivers every frame.
    surroundings
        Stray light; None: none.
    look_ahead
        Pulses queued for each worker; 0 where the scene depends on results from earlier frames.
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
        deliveries: Mapping[str, Delivery] | None = None,
        surroundings: Surroundings | None = None,
        look_ahead: int = LOOK_AHEAD,
    ) -> None:
        self.scene, self.virtual, self.pulses, self.seed = scene, tuple(cameras), pulses, seed
        self.frame_rate_hz, self.exposure_s, self.workers = frame_rate_hz, exposure_s, max(1, workers)
        self._look_ahead = look_ahead
        self._deliveries = dict(deliveries or {})
        names = [v.camera.name for v in self.virtual]
        for name in self._deliveries:
            if name not in names:
                raise InputError(f"deliveries: camera '{name}' given; the rig has {', '.join(names)}")
        self._subject = Subject.of(scene, self.virtual)
        self._sessions = tuple(
            CameraSession(
                v,
                self._subject,
                frame_rate_hz=frame_rate_hz,
                exposure_s=exposure_s,
                duration_s=pulses / frame_rate_hz,
                seed=seed,
            )
            for v in self.virtual
        )
        self._stray_light = None
        if surroundings is not None and surroundings != Surroundings():
            self._stray_light = StrayLight(surroundings, self._sessions)
        self._thread = local()
        self._latest: list[PulseLog] = []
        self._readings: set[_Reading] = set()

    @property
    def cameras(self) -> tuple[CameraInfo, ...]:
        """Each camera's description."""
        return tuple(session.info for session in self._sessions)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames as they arrive: pulse by pulse, in the rig's order; starts anew each time."""
        reading = _Reading(self.workers)
        self._latest = reading.log
        self._readings.add(reading)
        try:
            for frame in deliver(self._taken(reading), self._deliveries, self.seed):
                yield frame
                if reading.closed:
                    return
        finally:
            reading.close()
            self._readings.discard(reading)

    def close(self) -> None:
        """Stop the workers; iterations in progress end after the frame yielded last."""
        for reading in tuple(self._readings):
            reading.close()

    def __enter__(self) -> "TwinSource":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    @property
    def truth_xyz(self) -> list[Array]:
        """True marker positions (m, 3) of the pulses read so far [m]."""
        return [log.xyz for log in self._latest]

    def truth(self) -> Truth:
        """Return the true state at the pulses read so far."""
        return truth_of(list(self._latest), self._sessions, self.scene)

    def expected(self, pulse: int) -> tuple[Expected, ...]:
        """Return the mean of each camera's frame at ``pulse``, and its change when the image moves.

        Shake and opening of the camera are those of that frame; only sensor noise is averaged out. Stray light
        counts as background. A camera without a frame at that pulse is left out.
        """
        samples = SceneSamples(self._sampler(), self._subject.geoms, self._subject.bodies)
        found = []
        for camera, session in enumerate(self._sessions):
            for exposure in session.exposures(pulse)[:1]:
                exposed = session.prepare(exposure, samples)
                light = self._light_buffer(session)
                session.add_light(exposed, samples, light)
                rest, ambient = light.astype(float), session.ambient
                if self._stray_light is not None:
                    self._stray_light.add_targets(camera, exposed, samples, light)
                    ambient = self._stray_light.ambient(camera, exposed, samples, light)
                shifted = []
                for right, down in ((STEP_PX, 0.0), (-STEP_PX, 0.0), (0.0, STEP_PX), (0.0, -STEP_PX)):
                    light = self._light_buffer(session)
                    session.add_light(replace(exposed, lens=moved(exposed.lens, right, down)), samples, light)
                    shifted.append(light.copy())
                right_left_down_up = (shifted[0], shifted[1], shifted[2], shifted[3])
                virtual = session.virtual
                found.append(expected_frame(virtual.camera.name, virtual.sensor, ambient, rest, right_left_down_up))
        return tuple(found)

    def _taken(self, reading: _Reading) -> Iterator[Taken]:
        """Yield the cameras' frames in order, while the workers are ahead; ends when the reading is closed."""
        waiting: deque[Future[_Period]] = deque()
        ahead = self.workers * self._look_ahead
        for pulse in range(self.pulses + ahead):
            if pulse < self.pulses:
                future = reading.submit(self._expose_pulse, pulse)
                if future is None:
                    return
                waiting.append(future)
            if waiting and (len(waiting) > ahead or pulse >= self.pulses - 1):
                try:
                    period = waiting.popleft().result()
                except CancelledError:  # by ``close``, from another thread
                    return
                reading.log.append(period.log)
                yield from period.taken

    def _expose_pulse(self, pulse: int) -> _Period:
        """Return the frames that all cameras take from a pulse until the next."""
        samples = SceneSamples(self._sampler(), self._subject.geoms, self._subject.bodies)
        exposed_scenes = [[s.prepare(e, samples) for e in s.exposures(pulse)] for s in self._sessions]
        taken: list[Taken] = []
        true_exposures: list[tuple[TrueExposure, ...]] = []
        for camera, session in enumerate(self._sessions):
            own = []
            for exposed in exposed_scenes[camera]:
                light = self._light_buffer(session)
                own.append(session.add_light(exposed, samples, light))
                ambient = session.ambient
                if self._stray_light is not None:
                    self._stray_light.add_targets(camera, exposed, samples, light)
                    ambient = self._stray_light.ambient(camera, exposed, samples, light)
                frame = session.read_out(exposed.exposure, light, ambient)
                taken.append(Taken(frame, exposed.exposure.start_s, exposed.exposure.nominal_s))
            true_exposures.append(tuple(own))
        taken.sort(key=lambda one: one.due_s)  # stable: frames of one trigger keep the rig's order
        middle = pulse_time_s(pulse, self.frame_rate_hz) + self.exposure_s / 2
        xyz = samples.at(np.array([middle])).geom_xyz[0, self._subject.marker_at]
        return _Period(tuple(taken), PulseLog(middle, xyz, tuple(true_exposures)))

    def _sampler(self) -> SceneSampler:
        if not hasattr(self._thread, "sampler"):
            self._thread.sampler = self.scene.sampler()
        sampler: SceneSampler = self._thread.sampler
        return sampler

    def _light_buffer(self, session: CameraSession) -> Array:
        """Return this worker's buffer for the light on a camera's pixels (H, W) float32, zeroed."""
        shape = (session.virtual.camera.height, session.virtual.camera.width)
        buffers = self._thread.__dict__.setdefault("buffers", {})
        if shape not in buffers:
            buffers[shape] = np.empty(shape, dtype=np.float32)
        buffer: Array = buffers[shape]
        buffer.fill(0.0)
        return buffer
