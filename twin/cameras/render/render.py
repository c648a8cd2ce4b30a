"""Light on the sensor: every target's image integrated over the pixels, not rasterised.

Python's interface to the kernels (``target``). Where a mesh may hide a target, MuJoCo casts rays
(``mesh_occlusion``).
"""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from twin.cameras.optics.psf import Psf
from twin.cameras.render.inputs import (
    NO_FIGURES,
    Figures,
    RenderInputs,
    RowTiming,
    SolidArrays,
    TargetArrays,
    TargetsInCamera,
    Window,
)
from twin.cameras.render.mesh_occlusion import MeshRays
from twin.cameras.render.occluder_culling import motion_bounds
from twin.cameras.render.occluders import Occluders
from twin.cameras.render.outline import BALL, FIGURE, FLAT
from twin.cameras.render.target import (
    BY_PRIMITIVES,
    HIDDEN_GIVEN,
    MESH_NEAR,
    NO_BOUNDARY,
    ONLY_SPAN,
    REST_GIVEN,
    GivenBoundary,
    render_chosen,
)

__all__ = [
    "BALL",
    "FIGURE",
    "FLAT",
    "Figures",
    "MeshRays",
    "TargetsInCamera",
    "VisibleTargets",
    "Window",
    "has_meshes",
    "render_targets",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class VisibleTargets:
    """Visible share, image position and image diameter of each target in one frame."""

    visible: Array
    """(m,): visible share of the target's disc."""
    xy_px: Array
    """(m, 2): image of the centre at the mid-exposure of the target's rows; NaN where nothing is visible."""
    diameter_px: Array
    """(m,): diameter of the whole disc's image; NaN where nothing is visible."""


def render_targets(
    light: Array,
    lens: Array,
    psf: Psf,
    window: Window,
    targets: TargetsInCamera,
    occluders: Occluders,
    geom_xyz: Array,
    geom_rotation: Array,
    figures: Figures = NO_FIGURES,
    mesh_rays: "MeshRays | None" = None,
) -> VisibleTargets:
    """Add the targets' light to the pixels and return what is visible of each target.

    Parameters
    ----------
    light
        (H, W) float32 [electrons], added to in place.
    lens
        Parameter vector, see ``twin.cameras.optics.lens_vector``.
    psf
        Blur of the lens.
    window
        When the rows are exposed, and the K instants at which paths are given.
    targets, figures
        The targets to be rendered, and their figures.
    occluders
        The geoms that may hide the targets.
    geom_xyz, geom_rotation
        (K, k, 3) [m] and (K, k, 3, 3): the occluders' poses in the camera frame at the window's nodes.
    mesh_rays
        Occlusion by meshes, if there are any, at as many instants as their motion past the target needs.
    """
    on, off = window.light_s
    inputs = RenderInputs(
        lens,
        psf.kernel.taps,
        psf.kernel.reach,
        psf.terms,
        np.ascontiguousarray(window.nodes_s, dtype=float),
        RowTiming(float(window.length_s), float(window.row_time_s), float(on), float(off)),
        TargetArrays(
            targets.path,
            targets.rotation,
            targets.radius,
            targets.shape,
            targets.figure,
            targets.electrons,
            targets.lit_s,
            np.column_stack([targets.limb, targets.shade, targets.fade_rad]),
        ),
        figures.pieces,
        figures.first,
        SolidArrays(
            occluders.kind,
            occluders.size,
            occluders.marker,
            geom_xyz,
            geom_rotation,
            motion_bounds(occluders.kind, occluders.size, geom_xyz, geom_rotation),
        ),
    )
    count = len(targets.radius)
    mesh = np.zeros(count, dtype=np.int64) if mesh_rays is None else mesh_rays.candidates(targets)
    spans = np.zeros((count, 3))
    modes = np.where(mesh == 0, BY_PRIMITIVES, ONLY_SPAN)
    seen, state = render_chosen(light, inputs, np.arange(count), modes, NO_BOUNDARY, spans)
    if mesh_rays is not None:
        for m in np.flatnonzero(state == MESH_NEAR):
            edges, first, share, rest = mesh_rays.hidden(int(m), lens, targets, inputs.nodes_s, spans[m])
            mode = np.array([REST_GIVEN if rest else HIDDEN_GIVEN])
            given = GivenBoundary(edges, first, share)
            seen[m] = render_chosen(light, inputs, np.array([m]), mode, given, spans[m : m + 1])[0][0]
    seen[seen[:, 0] == 0.0, 1:] = np.nan
    return VisibleTargets(seen[:, 0], seen[:, 1:3], seen[:, 3])


def has_meshes(occluders: Occluders) -> bool:
    """Whether the scene has geoms that only ``MeshRays`` can answer for."""
    return len(occluders.mesh_geom) > 0
