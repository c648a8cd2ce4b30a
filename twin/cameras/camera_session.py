"""A camera during a session: everything about it that is computed once, and how it takes a frame."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.frames import CameraInfo, Frame
from twin.cameras.exposure.lighting import NEVER, LitIntervals, TargetLight, lit_during, target_light
from twin.cameras.exposure.mount import CameraSupport, pixels_per_radian
from twin.cameras.exposure.scene_sampling import (
    GeomPoses,
    SampledInterval,
    SceneSamples,
    View,
    interval_about,
    lobatto_nodes,
    seen_from,
)
from twin.cameras.exposure.shutter import Exposure, check_timing, numbers_in, open_shutter
from twin.cameras.optics.lens import TwinLens, warmed
from twin.cameras.optics.psf import psf_of
from twin.cameras.render.mesh_occlusion import MeshRays, SceneAt, interpolate
from twin.cameras.render.render import FLAT, TargetsInCamera, VisibleTargets, Window, has_meshes, render_targets
from twin.cameras.sensor.background_light import Ambient, ambient_map
from twin.cameras.sensor.readout import expose
from twin.cameras.subject import Subject, carrying_body
from twin.cameras.virtual_camera import VirtualCamera
from twin.streams import key

FEWEST_PERIODS = 0.08
"""Periods of the mount's fastest motion within a frame that three nodes can follow to 0.1 %."""


@dataclass(frozen=True, eq=False)
class TrueExposure:
    """The true state at the true mid-exposure of one frame."""

    exposure: Exposure
    seen: VisibleTargets
    rotation: Array
    """(3, 3): camera -> world."""
    position: Array
    """(3,): the camera's centre, world frame [m]."""
    marker_xyz: Array
    """(m, 3): the markers, world frame [m]."""


@dataclass(frozen=True, eq=False)
class ExposedScene:
    """The scene in front of a camera during one exposure."""

    exposure: Exposure
    window: Window
    times_s: Array
    """(k,) instants, session clock: the window's nodes, and the true mid-exposure where it is not one of them."""
    poses: GeomPoses
    """Poses of all geoms and bodies at these instants."""
    rotation: Array
    """(k, 3, 3): camera -> world at these instants."""
    position: Array
    """(k, 3): the camera's centre at these instants, world frame [m]."""
    middle: int
    """Index of the true mid-exposure in ``times_s``."""
    view: View
    """Targets and solids in the camera frame, at the window's nodes."""
    shining: TargetLight
    """Light of the targets."""
    lit: LitIntervals
    """When the targets shine."""
    lens: Array
    """Parameter vector at the exposure's temperature."""

    @property
    def half(self) -> int:
        """Number of the window's middle node."""
        return len(self.window.nodes_s) // 2

    @property
    def half_s(self) -> float:
        """The instant of the window's middle node, session clock [s]."""
        return float(self.times_s[self.half])


class CameraSession:
    """One virtual camera during a session; may be used by several threads at once.

    Raises InputError where its timing is impossible.
    """

    def __init__(
        self,
        virtual: VirtualCamera,
        subject: Subject,
        *,
        frame_rate_hz: float,
        exposure_s: float,
        duration_s: float,
        seed: int,
    ) -> None:
        camera, timing = virtual.camera, virtual.timing
        check_timing(timing, camera.name, camera.height, frame_rate_hz, exposure_s)
        self.virtual, self.subject, self.seed = virtual, subject, seed
        self.frame_rate_hz, self.exposure_s = frame_rate_hz, exposure_s
        self.free = timing.rate_hz is not None
        self.lens = TwinLens.of(camera.lens, camera.width, camera.height, virtual.optics)
        self.psf = psf_of(virtual.optics, camera.width, camera.height)
        self.ambient = _ambient(virtual, exposure_s, seed)
        self.signal_e = virtual.marker_signal * virtual.sensor.full_well_e
        self._support = CameraSupport.of(
            virtual.mount,
            camera.name,
            camera.world_from_camera,
            pixels_per_radian(self.lens.vector),
            seed,
            duration_s,
        )
        self._body = None
        if virtual.mount.body is not None:
            self._body = int(np.searchsorted(subject.bodies, carrying_body(subject.scene, virtual)))
        # plain targets are equally bright from everywhere, and without codes and strobes they shine all the time
        m = len(subject.radius)
        self._even, self._lit_always = None, None
        if subject.even:
            ahead = np.tile([0.0, 0.0, 1.0], (m, 1))
            self._even = target_light(subject.glows, self.signal_e, ahead, -ahead, np.zeros(3), np.eye(3))
        if not any(subject.glows.blinks) and timing.strobe_s is None:
            self._lit_always = lit_during(subject.glows, 0.0, 1.0)

    @property
    def info(self) -> CameraInfo:
        """The camera's description."""
        camera, timing = self.virtual.camera, self.virtual.timing
        rate = self.frame_rate_hz if timing.rate_hz is None else timing.rate_hz
        bits = self.virtual.sensor.bits
        return CameraInfo(camera.name, camera.width, camera.height, bits, rate, timing.clock, timing.stamp_event)

    def exposures(self, pulse: int) -> list[Exposure]:
        """Return the exposures that the camera begins from a pulse until the next."""
        return [self.exposure(n) for n in numbers_in(self.virtual.timing, pulse, self.frame_rate_hz)]

    def exposure(self, number: int) -> Exposure:
        """Return the exposure of frame ``number``."""
        timing, camera = self.virtual.timing, self.virtual.camera
        return open_shutter(
            timing, camera.name, number, self.frame_rate_hz, self.exposure_s, self.seed, camera.height
        )

    def pose_at(self, times_s: Array, frame: int, poses: GeomPoses) -> tuple[Array, Array]:
        """Return ``world_from_camera`` at instants (k,); ``poses``: those of all geoms and bodies at them."""
        carrier = None
        if self._body is not None:
            carrier = (poses.body_rotation[:, self._body], poses.body_xyz[:, self._body])
        return self._support.pose_at(times_s, frame, carrier)

    def prepare(self, exposure: Exposure, samples: SceneSamples) -> ExposedScene:
        """Return the scene in front of the camera during an exposure: mount, poses and the targets' light."""
        subject = self.subject
        nodes = self._nodes_s(exposure)
        times, half = exposure.start_s + nodes, len(nodes) // 2
        middle = half
        if abs(times[half] - exposure.middle_s) > 1e-12:
            times, middle = np.append(times, exposure.middle_s), len(nodes)
        poses = samples.at(times, self._interval(exposure))
        rotation, position = self.pose_at(times, exposure.number, poses)
        return ExposedScene(
            exposure,
            Window(nodes, exposure.length_s, exposure.row_time_s),
            times,
            poses,
            rotation,
            position,
            middle,
            seen_from(rotation, position, poses, subject.marker_at, subject.solid_at, len(nodes)),
            self._even or self._light(poses, half, rotation[half], position[half]),
            self._lit_always or self._lit(exposure),
            warmed(self.lens.vector, self.virtual.optics, exposure.middle_s),
        )

    def _light(self, poses: GeomPoses, at: int, rotation: Array, position: Array) -> TargetLight:
        """Return the targets' light at one of the instants of ``poses``."""
        subject = self.subject
        xyz, axis = poses.geom_xyz[at, subject.marker_at], poses.geom_rotation[at, subject.marker_at, :, 2]
        flat = np.where(subject.shape == FLAT, subject.radius, 0.0)
        return target_light(subject.glows, self.signal_e, xyz, axis, position, rotation, flat)

    def _lit(self, exposure: Exposure) -> LitIntervals:
        """Return when the targets shine."""
        on, off = exposure.light_s
        strobe = (on - exposure.start_s, off - exposure.start_s)
        return lit_during(self.subject.glows, exposure.start_s, exposure.span_s, strobe)

    def add_light(self, exposed: ExposedScene, samples: SceneSamples, light: Array) -> TrueExposure:
        """Add the targets' light to the camera's pixels (H, W) float32 [electrons]; return the true state."""
        subject, view = self.subject, exposed.view
        mesh_rays = None
        if has_meshes(subject.occluders):
            mesh_rays = MeshRays(
                subject.scene.model,
                _scene_at(exposed, samples),
                exposed.half_s - exposed.exposure.start_s,
                subject.occluders,
                subject.scene.marker_geoms,
            )

        def render(lit_s: Array) -> VisibleTargets:
            targets = TargetsInCamera(
                view.path,
                view.rotation,
                subject.radius,
                subject.shape,
                subject.figure,
                exposed.shining.electrons,
                lit_s,
                exposed.shining.limb,
                exposed.shining.shade,
                exposed.shining.fade_rad,
            )
            return render_targets(
                light,
                exposed.lens,
                self.psf,
                exposed.window,
                targets,
                subject.occluders,
                view.solid_xyz,
                view.solid_rotation,
                subject.figures,
                mesh_rays,
            )

        seen = render(exposed.lit.first)
        for again in _rounds(exposed.lit, len(subject.marker_at)):
            render(again)
        middle = exposed.middle
        markers = exposed.poses.geom_xyz[middle, subject.marker_at]
        return TrueExposure(exposed.exposure, seen, exposed.rotation[middle], exposed.position[middle], markers)

    def read_out(self, exposure: Exposure, light: Array, ambient: Ambient) -> Frame:
        """Return the frame that the sensor makes of the targets' light (H, W) and the ambient light."""
        name = self.virtual.camera.name
        random = key(self.seed, f"camera/{name}/sensor", exposure.number)
        return Frame(
            name,
            exposure.number,
            exposure.stamp_ns,
            exposure.exposure_ns,
            expose(light, self.virtual.sensor, random, ambient),
            stamp_event=self.virtual.timing.stamp_event,
            row_time_ns=exposure.row_time_ns,
        )

    def _nodes_s(self, exposure: Exposure) -> Array:
        """Return the instants at which paths are given, from the first row's opening [s].

        A global shutter has three instants. A rolling shutter has Chebyshev-Gauss-Lobatto nodes over its readout.
        Where the mount moves fast, either has more of these nodes.
        """
        span = exposure.span_s
        periods = self._support.mount.fastest_hz(exposure.start_s, exposure.end_s) * span
        if periods > FEWEST_PERIODS:
            return lobatto_nodes(span, 5 + 2 * math.ceil(2.0 * periods))
        if exposure.row_time_s == 0.0:
            return np.array([0.0, 0.5 * span, span])
        return lobatto_nodes(span, 5 if span <= 0.003 else 7 if span <= 0.010 else 9)

    def _interval(self, exposure: Exposure) -> SampledInterval | None:
        """Return the interval of time for which cameras with similar timing share the sampled geometry."""
        if self.free:
            return None
        timing, span = self.virtual.timing, exposure.span_s
        return interval_about(exposure.nominal_s + timing.delay_s + 0.5 * span, span, timing.jitter_s)


def _scene_at(exposed: ExposedScene, samples: SceneSamples) -> SceneAt:
    """Return the function that gives scene and camera at an instant of an exposure."""
    nodes = exposed.window.nodes_s
    k = len(nodes)

    def at(time_s: float) -> tuple[Any, Array, Array]:
        data = samples.hold(exposed.exposure.start_s + time_s).data
        rotation, position = exposed.rotation[:k], exposed.position[:k]
        return data, interpolate(rotation, nodes, time_s), interpolate(position, nodes, time_s)

    return at


def _ambient(virtual: VirtualCamera, exposure_s: float, seed: int) -> Ambient:
    """Return the light that the camera's pixels collect besides the targets, and the loss in its glass."""
    camera, sensor = virtual.camera, virtual.sensor
    length = exposure_s if virtual.timing.exposure_s is None else virtual.timing.exposure_s
    light = ambient_map(
        sensor,
        camera.width,
        camera.height,
        key(seed, f"camera/{camera.name}/pixels"),
        exposure_s=length,
        vignetting=virtual.optics.vignetting,
        backdrop=virtual.backdrop,
    )
    return Ambient.of(sensor, light.mean_e, light.flat, shape=(camera.height, camera.width))


def _rounds(lit: LitIntervals, count: int) -> list[Array]:
    """Return intervals (m, 2) for each further time that targets shine; NEVER for targets that do not then."""
    rounds: list[Array] = []
    times = np.zeros(count, dtype=int)
    for target, interval in zip(lit.again, lit.again_s, strict=True):
        if times[target] == len(rounds):
            rounds.append(np.tile(np.array(NEVER), (count, 1)))
        rounds[times[target]][target] = interval
        times[target] += 1
    return rounds
