"""Stray light of a session: reflections as targets, context image and glare as light on pixels."""

import math
from dataclasses import replace

import numpy as np

from mosca.data.arrays import Array
from twin.cameras.camera_session import CameraSession, ExposedScene
from twin.cameras.exposure.lighting import ALWAYS
from twin.cameras.exposure.scene_sampling import SceneSamples
from twin.cameras.render.occluders import Occluders
from twin.cameras.render.render import Figures, TargetsInCamera, render_targets
from twin.cameras.sensor.background_light import Ambient
from twin.cameras.stray_light.context_image import ContextView, Refreshed, context_image, context_view, refresh_pulse
from twin.cameras.stray_light.glare import veil
from twin.cameras.stray_light.mirror import SceneRays, with_mirrored
from twin.cameras.stray_light.stray import Surroundings, stray_targets, unhidden
from twin.cameras.stray_light.world import RigPoses, TargetsInWorld

KEPT_PER_CAMERA = 4
"""Number of context images kept for each camera, since workers are a few frames apart."""


class StrayLight:
    """Stray light in the cameras of ``sessions``; may be used by several threads at once.

    Raises InputError for a cloth whose pattern fits no geom of the scene.
    """

    def __init__(self, surroundings: Surroundings, sessions: tuple[CameraSession, ...]) -> None:
        self._given, self._sessions = surroundings, sessions
        self._subject = sessions[0].subject
        scene = self._subject.scene
        printed = [scene.figures[name] for name in scene.marker_names if name in scene.figures]
        self._figure_count, self._figures = len(printed), Figures.of(with_mirrored(printed))
        occluders = self._subject.occluders
        # the numbers of stray targets are not those of markers: every geom may hide them
        self._occluders = replace(occluders, marker=np.full_like(occluders.marker, -1))
        self._views: tuple[ContextView, ...] = ()
        if surroundings.context is not None:
            self._views = tuple(
                context_view(
                    scene,
                    s.lens,
                    s.virtual.camera.width,
                    s.virtual.camera.height,
                    surroundings.context,
                    s.virtual.sensor.full_well_e,
                )
                for s in sessions
            )
        self._refreshed = Refreshed(keep=KEPT_PER_CAMERA * len(sessions))

    def add_targets(self, camera: int, exposed: ExposedScene, samples: SceneSamples, light: Array) -> None:
        """Add the stray targets' light to the pixels (H, W) [electrons] of camera number ``camera``."""
        if not self._given.has_targets:
            return
        session, subject = self._sessions[camera], self._subject
        nodes = len(exposed.window.nodes_s)
        stray = stray_targets(
            self._given,
            camera=camera,
            rig_poses=self._rig_poses(camera, exposed),
            targets=self._in_world(exposed),
            signal_e=session.signal_e,
            rays=SceneRays(subject.scene.model, samples.hold(exposed.half_s).data),
            figures=self._figure_count,
        )

        def render(targets: TargetsInCamera, hiding: tuple[Occluders, Array, Array]) -> None:
            if len(targets.radius):
                render_targets(
                    light, exposed.lens, session.psf, exposed.window, targets, *hiding, figures=self._figures
                )

        render(stray.direct, (self._occluders, exposed.view.solid_xyz, exposed.view.solid_rotation))
        render(stray.mirrored, unhidden(nodes))

    def ambient(self, camera: int, exposed: ExposedScene, samples: SceneSamples, light: Array) -> Ambient:
        """Return the light that the camera's pixels collect besides the targets' ``light`` (H, W) [electrons]."""
        session = self._sessions[camera]
        ambient, total = session.ambient, light
        if self._given.context is not None:
            image, ambient = self._context(camera, exposed, samples)
            total = light + image
        if self._given.glare.share > 0.0:
            ambient = ambient.with_extra(veil(total, self._given.glare))
        return ambient

    def _context(self, camera: int, exposed: ExposedScene, samples: SceneSamples) -> tuple[Array, Ambient]:
        """Return the context image that is valid at a frame, and the ambient light with it."""
        session, context = self._sessions[camera], self._given.context
        assert context is not None
        first = refresh_pulse(exposed.exposure.number, session.info.frame_rate_hz, context.rate_hz)

        def make() -> tuple[Array, Ambient]:
            at = np.array([session.exposure(first).middle_s])
            rotation, position = session.pose_at(at, first, samples.at(at))
            image = context_image(
                self._views[camera], samples.hold(float(at[0])), float(at[0]), rotation[0], position[0]
            )
            bare = session.ambient
            through = image if bare.flat is None else image * bare.flat
            return image, Ambient.of(session.virtual.sensor, bare.mean_e + through, bare.flat)

        made: tuple[Array, Ambient] = self._refreshed.get((camera, first), make)
        return made

    def _in_world(self, exposed: ExposedScene) -> TargetsInWorld:
        """Return the scene's targets, for mirrors."""
        subject, k = self._subject, len(exposed.window.nodes_s)
        return TargetsInWorld(
            exposed.poses.geom_xyz[:k, subject.marker_at].transpose(1, 0, 2),
            exposed.poses.geom_rotation[:k, subject.marker_at].transpose(1, 0, 2, 3),
            subject.radius,
            subject.shape,
            subject.figure,
            np.asarray(subject.scene.marker_geoms, dtype=np.int64),
            subject.glows,
            exposed.lit.first,
        )

    def _rig_poses(self, camera: int, exposed: ExposedScene) -> RigPoses:
        """Return the poses of all cameras while one exposes, and the intervals in which their ring lights shine."""
        k = len(exposed.window.nodes_s)
        rotations, positions, lit = [], [], []
        for number, session in enumerate(self._sessions):
            if number == camera:
                rotation, position = exposed.rotation, exposed.position
            else:
                rotation, position = session.pose_at(exposed.times_s, exposed.exposure.number, exposed.poses)
            rotations.append(rotation[:k])
            positions.append(position[:k])
            lit.append(self._shining(session, exposed))
        return RigPoses(np.array(positions), np.array(rotations), np.array(lit))

    def _shining(self, session: CameraSession, exposed: ExposedScene) -> tuple[float, float]:
        """Return when a camera's strobe is on while another one exposes, in seconds from the latter's opening."""
        if session.virtual.timing.strobe_s is None:
            return ALWAYS
        opens, closes = exposed.exposure.start_s, exposed.exposure.end_s
        pulse = math.floor(opens * session.frame_rate_hz)
        lights = [
            exposure.light_s
            for near in (pulse - 1, pulse, pulse + 1)
            if near >= 0
            for exposure in session.exposures(near)
        ]
        best = max(lights, key=lambda on: min(on[1], closes) - max(on[0], opens), default=(opens, opens))
        return best[0] - opens, best[1] - opens
