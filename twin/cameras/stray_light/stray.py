"""Surroundings: light on the images that does not come straight from a target of the scene.

Ring lights of other cameras, shiny spots and mirror images are targets like others: bright bodies in front of the
camera, integrated by the same renderer. They never enter the truth. Context and glare, which cover the whole image,
are light on pixels (``context_image``, ``glare``).
"""

from dataclasses import dataclass, field

import numpy as np

from mosca.data.arrays import Array
from twin.cameras.render.occluders import Occluders
from twin.cameras.render.render import TargetsInCamera
from twin.cameras.stray_light.context_image import Context
from twin.cameras.stray_light.glare import Glare
from twin.cameras.stray_light.mirror import PlaneMirror, SceneRays, mirrored
from twin.cameras.stray_light.world import (
    RigPoses,
    RingLight,
    ShinySpot,
    TargetsInWorld,
    in_camera,
    joined,
    ring_lights,
    shiny_spots,
)


@dataclass(frozen=True)
class Surroundings:
    """Stray light of a rig and its subject; the default is none."""

    context: Context | None = None
    """Context image of scene and body; None: none."""
    ring_light: RingLight | None = None
    """Ring lights of the cameras, as the others see them."""
    spots: tuple[ShinySpot, ...] = ()
    mirrors: tuple[PlaneMirror, ...] = ()
    glare: Glare = field(default_factory=Glare)

    @property
    def has_targets(self) -> bool:
        """Whether ``stray_targets`` returns any targets."""
        return self.ring_light is not None or bool(self.spots) or bool(self.mirrors)


@dataclass(frozen=True, eq=False)
class Stray:
    """Stray light as targets."""

    direct: TargetsInCamera
    """Targets for which the renderer computes the occlusion by the scene."""
    mirrored: TargetsInCamera
    """Mirror images, to be rendered without occluders: their occlusion is included."""


def stray_targets(
    surroundings: Surroundings,
    *,
    camera: int,
    rig_poses: RigPoses,
    targets: TargetsInWorld,
    signal_e: float,
    rays: SceneRays,
    figures: int = 0,
) -> Stray:
    """Return the stray light on camera number ``camera`` of ``rig_poses`` in one exposure.

    ``targets``: the scene's own, for the mirrors; ``signal_e``: electrons of a pixel covered by a marker; ``rays``:
    the scene at mid-exposure; ``figures``: the number of figures of the scene. In a mirror a camera also sees its
    own ring light.
    """
    position, rotation = rig_poses.position[camera], rig_poses.rotation[camera]
    nodes = len(position)
    lights = surroundings.ring_light or RingLight()
    everyone = range(len(rig_poses.position)) if surroundings.ring_light is not None else range(0)
    others = ring_lights(lights, rig_poses, [c for c in everyone if c != camera])
    spots = shiny_spots(surroundings.spots, position[nodes // 2], nodes)
    direct = [in_camera(part, signal_e, position, rotation) for part in (others, spots)]
    images = [in_camera(_none(nodes), signal_e, position, rotation)]
    for mirror in surroundings.mirrors:
        seen_in_it = shiny_spots(surroundings.spots, mirror.image(position[nodes // 2]), nodes)
        for part in (targets, ring_lights(lights, rig_poses, list(everyone)), seen_in_it):
            images.append(mirrored(mirror, part, signal_e, position, rotation, rays, figures))
    return Stray(joined(*direct), joined(*images))


def unhidden(nodes: int) -> tuple[Occluders, Array, Array]:
    """Return the renderer's ``occluders``, ``geom_xyz`` and ``geom_rotation`` where nothing hides anything."""
    none, size = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    occluders = Occluders(none, none, size, none, none, np.zeros(0))
    return occluders, np.zeros((nodes, 0, 3)), np.zeros((nodes, 0, 3, 3))


def _none(nodes: int) -> TargetsInWorld:
    return shiny_spots((), np.zeros(3), nodes)
