"""The scene of a session in the form that the kernels read: targets and occluders, the same for all cameras."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from mosca.errors import InputError
from twin.cameras.exposure.lighting import PLAIN, GlowTable, scene_glows
from twin.cameras.render.occluders import Occluders, occluders_of
from twin.cameras.render.render import BALL, FIGURE, FLAT, Figures
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class Subject:
    """A scene's targets (m) and the solids that hide them, for all cameras."""

    scene: Scene
    radius: Array
    """(m,) [m]."""
    shape: Array
    """(m,): BALL, FLAT or FIGURE."""
    figure: Array
    """(m,): number in ``figures`` or -1."""
    figures: Figures
    glows: GlowTable
    occluders: Occluders
    geoms: Array
    """(g,): ids of the geoms of targets and occluders."""
    marker_at: Array
    """(m,): positions of the markers in ``geoms``."""
    solid_at: Array
    """(k,): positions of the occluders in ``geoms``."""
    bodies: Array
    """(b,): ids of the bodies that carry cameras."""

    @property
    def even(self) -> bool:
        """Whether all targets are equally bright from everywhere."""
        return bool((self.glows.kind == PLAIN).all()) and not self.glows.shade.any()

    @classmethod
    def of(cls, scene: Scene, cameras: tuple[VirtualCamera, ...]) -> "Subject":
        """Return a scene for ``cameras``; InputError for a camera on a body that the scene does not have."""
        markers = np.asarray(scene.marker_geoms, dtype=np.int64)
        occluders = occluders_of(scene)
        geoms = np.union1d(markers, occluders.geom)
        printed = tuple(name for name in scene.marker_names if name in scene.figures)
        figure = [printed.index(name) if name in printed else -1 for name in scene.marker_names]
        sphere = scene.model.geom_type[markers] == 2
        shape = np.where(sphere, BALL, np.where(np.array(figure) >= 0, FIGURE, FLAT)).astype(np.int64)
        radius = np.array(scene.model.geom_size[markers, 0], dtype=float)
        for k, name in enumerate(scene.marker_names):
            if name in printed:
                radius[k] = scene.figures[name].radius
        return cls(
            scene,
            radius,
            shape,
            np.array(figure, dtype=np.int64),
            Figures.of(tuple(scene.figures[name] for name in printed)),
            scene_glows(scene),
            occluders,
            geoms,
            np.searchsorted(geoms, markers),
            np.searchsorted(geoms, occluders.geom),
            np.array(sorted({carrying_body(scene, v) for v in cameras if v.mount.body is not None}), dtype=np.int64),
        )


def carrying_body(scene: Scene, virtual: VirtualCamera) -> int:
    """Return the id of the body that carries a camera."""
    names = [scene.model.body(k).name for k in range(scene.model.nbody)]
    if virtual.mount.body not in names:
        known = ", ".join(name for name in names if name)
        raise InputError(
            f"camera '{virtual.camera.name}', mount: body = {virtual.mount.body!r} given; the scene has {known}"
        )
    return names.index(virtual.mount.body)
