"""Light on the sensor: every target's image integrated, not drawn.

The door to the kernels (``integrate``). Where meshes are about, MuJoCo is asked ray by ray (``mesh_rays``).
"""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from twin.cameras.exposure.render_inputs import NO_FIGURES, Figures, TargetsInCamera, Window
from twin.cameras.optics.psf import Psf
from twin.cameras.render.mesh_occlusion import MeshRays
from twin.cameras.render.occluder_culling import solids_of
from twin.cameras.render.occluders import Occluders
from twin.cameras.render.outline import BALL, FIGURE, FLAT
from twin.cameras.render.target import MESH_NEAR, MESH_REST, render_all, render_one

__all__ = [
    "BALL", "FIGURE", "FLAT", "Figures", "MeshRays", "Seen", "TargetsInCamera", "Window", "has_meshes",
    "render_targets",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Seen:
    """What the camera saw of each target: ``visible`` (m,) share of its disc, ``xy_px`` (m, 2) image of its
    centre at its rows' mid-exposure, ``diameter_px`` (m,) of the whole disc's image (both NaN where nothing is
    visible).
    """

    visible: Array
    xy_px: Array
    diameter_px: Array


def render_targets(
    light: Array,
    lens: Array,
    psf: Psf,
    window: Window,
    targets: TargetsInCamera,
    occluders: Occluders,
    geom_xyz: Array,
    geom_turn: Array,
    figures: Figures = NO_FIGURES,
    mesh_rays: "MeshRays | None" = None,
) -> Seen:
    """Add the targets' light to ``light`` (H, W) [electrons], in place, and return what was seen of them.

    ``lens``: parameter vector of ``twin.cameras.optics.lens``. ``geom_xyz`` (K, k, 3), ``geom_turn`` (K, k, 3, 3):
    the occluders' poses in the camera frame at the window's nodes. ``mesh_rays`` answers for meshes, if there are
    any; they are judged at as many instants as they pass the target.
    """
    count = len(targets.radius)
    nodes = np.ascontiguousarray(window.nodes_s, dtype=float)
    timing = (window.length_s, window.row_time_s, float(window.light_s[0]), float(window.light_s[1]))
    profile = np.column_stack([targets.limb, targets.shade])
    common = (
        light, lens, psf.kernel.table, psf.kernel.reach, psf.terms, nodes, timing, targets.path, targets.turn,
        targets.radius, targets.shape, targets.figure, targets.electrons, targets.lit_s, profile,
        figures.pieces, figures.first, occluders.kind, occluders.size, occluders.marker, geom_xyz, geom_turn,
        solids_of(occluders.kind, occluders.size, geom_xyz, geom_turn),
    )  # fmt: skip
    mesh = np.zeros(count, dtype=np.int64) if mesh_rays is None else mesh_rays.candidates(targets)
    seen, state, spans = render_all(*common, mesh)
    if mesh_rays is not None:
        for m in np.flatnonzero(state == MESH_NEAR):
            edges, first, share, rest = mesh_rays.hidden(int(m), lens, targets, nodes, spans[m])
            how = MESH_REST if rest else MESH_NEAR
            seen[m] = render_one(*common, int(m), how, spans[m], edges, first, share)[:4]
    seen[seen[:, 0] == 0.0, 1:] = np.nan
    return Seen(seen[:, 0], seen[:, 1:3], seen[:, 3])


def has_meshes(occluders: Occluders) -> bool:
    """Whether the scene has geoms that only ``MeshRays`` can answer for."""
    return len(occluders.mesh_geom) > 0
