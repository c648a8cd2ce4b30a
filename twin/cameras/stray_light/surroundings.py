"""What surrounds a rig in a session: stray light as targets, context and glare as light on pixels."""

import math
from dataclasses import replace

import numpy as np

from mosca.data.arrays import Array
from twin.cameras.camera_session import Sight, Station
from twin.cameras.exposure.lighting import ALWAYS
from twin.cameras.exposure.scene_sampling import Moment
from twin.cameras.render.occluders import Occluders
from twin.cameras.render.render import Figures, TargetsInCamera, render_targets
from twin.cameras.sensor.background_light import Ambient
from twin.cameras.stray_light.context_image import (
    ContextView,
    Refreshed,
    context_image,
    context_view,
    refresh_pulse,
)
from twin.cameras.stray_light.glare import veil
from twin.cameras.stray_light.mirror import SceneRays, with_mirrored
from twin.cameras.stray_light.stray import Surroundings, stray_targets, unhidden
from twin.cameras.stray_light.world import Heads, TargetsInWorld

KEPT_PER_CAMERA = 4
"""Context images that stand ready for each camera: workers are a few frames apart."""


class Around:
    """The surroundings of ``stations``; may be used by several threads at once.

    Raises InputError for a cloth that nothing in the scene wears.
    """

    def __init__(self, surroundings: Surroundings, stations: tuple[Station, ...]) -> None:
        self._given, self._stations = surroundings, stations
        self._subject = stations[0].subject
        scene = self._subject.scene
        printed = [scene.figures[name] for name in scene.marker_names if name in scene.figures]
        self._figure_count, self._figures = len(printed), Figures.of(with_mirrored(printed))
        occluders = self._subject.occluders
        # numbers of stray targets are no markers' numbers: every geom may hide them
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
                for s in stations
            )
        self._refreshed = Refreshed(keep=KEPT_PER_CAMERA * len(stations))

    def add_targets(self, camera: int, sight: Sight, moment: Moment, light: Array) -> None:
        """Add the stray targets' light to the pixels (H, W) [electrons] of camera number ``camera``."""
        if not self._given.has_targets:
            return
        station, subject = self._stations[camera], self._subject
        nodes = len(sight.window.nodes_s)
        stray = stray_targets(
            self._given,
            camera=camera,
            heads=self._heads(camera, sight),
            targets=self._in_world(sight),
            signal_e=station.signal_e,
            rays=SceneRays(subject.scene.model, moment.hold(sight.half_s).data),
            figures=self._figure_count,
        )

        def render(targets: TargetsInCamera, hiding: tuple[Occluders, Array, Array]) -> None:
            if len(targets.radius):
                render_targets(
                    light, sight.lens, station.psf, sight.window, targets, *hiding, figures=self._figures
                )

        render(stray.direct, (self._occluders, sight.view.solid_xyz, sight.view.solid_turn))
        render(stray.mirrored, unhidden(nodes))

    def ambient(self, camera: int, sight: Sight, moment: Moment, light: Array) -> Ambient:
        """Return what the camera's pixels collect besides the targets' ``light`` (H, W) [electrons]."""
        station = self._stations[camera]
        ambient, total = station.ambient, light
        if self._given.context is not None:
            image, ambient = self._context(camera, sight, moment)
            total = light + image
        if self._given.glare.share > 0.0:
            ambient = ambient.with_extra(veil(total, self._given.glare))
        return ambient

    def _context(self, camera: int, sight: Sight, moment: Moment) -> tuple[Array, Ambient]:
        """Return the context image that stands at a frame, and the ambient light with it."""
        station, context = self._stations[camera], self._given.context
        assert context is not None
        first = refresh_pulse(sight.exposure.number, station.info.frame_rate_hz, context.rate_hz)

        def make() -> tuple[Array, Ambient]:
            at = np.array([station.exposure(first).middle_s])
            rotation, position = station.pose_at(at, first, moment.at(at))
            image = context_image(
                self._views[camera], moment.hold(float(at[0])), float(at[0]), rotation[0], position[0]
            )
            bare = station.ambient
            through = image if bare.flat is None else image * bare.flat
            return image, Ambient.of(station.virtual.sensor, bare.mean_e + through, bare.flat)

        made: tuple[Array, Ambient] = self._refreshed.get((camera, first), make)
        return made

    def _in_world(self, sight: Sight) -> TargetsInWorld:
        """Return the scene's targets, for mirrors."""
        subject, k = self._subject, len(sight.window.nodes_s)
        return TargetsInWorld(
            sight.places.geom_xyz[:k, subject.marker_at].transpose(1, 0, 2),
            sight.places.geom_turn[:k, subject.marker_at].transpose(1, 0, 2, 3),
            subject.radius,
            subject.shape,
            subject.figure,
            np.asarray(subject.scene.marker_geoms, dtype=np.int64),
            subject.glows,
            sight.lit.first,
        )

    def _heads(self, camera: int, sight: Sight) -> Heads:
        """Return where all cameras are while one exposes, and when their ring lights shine."""
        k = len(sight.window.nodes_s)
        turns, places, lit = [], [], []
        for number, station in enumerate(self._stations):
            if number == camera:
                turn, place = sight.rotation, sight.position
            else:
                turn, place = station.pose_at(sight.times_s, sight.exposure.number, sight.places)
            turns.append(turn[:k])
            places.append(place[:k])
            lit.append(self._shining(station, sight))
        return Heads(np.array(places), np.array(turns), np.array(lit))

    def _shining(self, station: Station, sight: Sight) -> tuple[float, float]:
        """Return when a camera's strobe is on while another exposes, in seconds from that one's opening."""
        if station.virtual.timing.strobe_s is None:
            return ALWAYS
        opens, closes = sight.exposure.start_s, sight.exposure.end_s
        pulse = math.floor(opens * station.frame_rate_hz)
        lights = [
            exposure.light_s
            for near in (pulse - 1, pulse, pulse + 1)
            if near >= 0
            for exposure in station.exposures(near)
        ]
        best = max(lights, key=lambda on: min(on[1], closes) - max(on[0], opens), default=(opens, opens))
        return best[0] - opens, best[1] - opens
