"""Frame sets of any content: matching reads and writes inside its arrays, and uses each camera's own detections.

With ``NUMBA_BOUNDSCHECK=1`` (a shard of ``.ci/nightly``) an index outside an array is an error; without it, the
results are checked, which a read outside an array would change.
"""

from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs import ring

from mosca.camera.projection import project
from mosca.camera.ray_table import make_ray_table
from mosca.correspondence.match import EVERYWHERE, MatchSettings, match
from mosca.correspondence.spatial_index import CELLS, CORNER, SCALE, cell_of, cells
from mosca.data.detections import MERGED, PARTIAL, SATURATED, UNREFINED, Detections
from mosca.data.rays import Predicted
from mosca.data.rig import Rig

SIGMA_PX = 0.05
OUTSIDE = 1e7
"""A pixel position that no lens images."""


def detections(name, xy, rng):
    """Return detections at ``xy`` (n, 2) with flags and sizes of every kind."""
    n = len(xy)
    flags = rng.choice([0, MERGED, PARTIAL, SATURATED, UNREFINED], n)
    return Detections(
        name, xy, np.tile(SIGMA_PX**2 * np.eye(2), (n, 1, 1)), rng.uniform(0.5, 30.0, n), np.full(n, 100.0),
        rng.uniform(1.0, 3.0, n), flags=flags,
    )  # fmt: skip


@given(
    counts=st.lists(st.integers(0, 12), min_size=2, max_size=6),
    clutter=st.lists(st.integers(0, 12), min_size=6, max_size=6),
    spread_m=st.sampled_from([0.0, 1e-9, 0.01, 0.5, 5.0]),
    nowhere=st.booleans(),
    coincident=st.booleans(),
    track_m2=st.sampled_from([0.0, 1e-12, 1e-4, 1e6, 1e300, np.inf, np.nan]),
    target=st.sampled_from(["auto", "point", "ball"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_frame_set_of_any_content(counts, clutter, spread_m, nowhere, coincident, track_m2, target, seed):
    rng = np.random.default_rng(seed)
    rig = ring(len(counts))
    if coincident:
        cameras = rig.cameras
        rig = Rig((replace(cameras[0], world_from_camera=cameras[1].world_from_camera), *cameras[1:]))
    targets = rng.uniform(-spread_m, spread_m, (12, 3))
    found = {}
    for camera, seen, random in zip(rig.cameras, counts, clutter, strict=False):
        xy = project(camera, targets)[rng.permutation(12)[:seen]]
        xy = np.concatenate([xy[np.isfinite(xy).all(axis=1)], rng.uniform((0, 0), (655, 490), (random, 2))])
        if nowhere and len(xy):
            xy[rng.integers(len(xy))] = OUTSIDE
        found[camera.name] = detections(camera.name, xy, rng)
    tracks = rng.integers(0, 5)
    expected = Predicted(targets[:tracks], np.tile(np.diag(np.full(3, track_m2)), (tracks, 1, 1)))
    settings = MatchSettings(camera_sigma_px=0.0)
    points = match(make_ray_table(rig, found, 0.0, target), expected, settings, EVERYWHERE, rng.choice([0.0, 0.014]))
    limits = np.array([len(found[name]) for name in rig.names])
    assert (points.rays >= -1).all()
    assert (points.rays < limits).all()
    assert np.isfinite(points.xyz).all()
    assert (points.n_cameras == (points.rays >= 0).sum(axis=1)).all()


@numba.njit
def cell_at(rays, views, start, value, half):
    """The row in which matching looks for ``value`` -+ ``half`` in the last camera, and that camera's rows."""
    frame = cells(rays, views, start)[0][-1]
    return cell_of(value + half, frame[CORNER], frame[SCALE], frame[CELLS]), frame[CELLS]


@pytest.mark.parametrize(("value", "half"), [(0.3, 0.0), (0.3, np.inf), (-0.3, np.nan), (np.nan, 0.1)])
@pytest.mark.parametrize("last", [0, 1, 5])
def test_every_search_stays_inside_the_cells(value, half, last):
    # one camera dead: the smallest coordinate of no rays is infinite, and infinity x 0 is no number
    rig, rng = ring(2), np.random.default_rng(0)
    found = {"c0": detections("c0", rng.uniform(0, 400, (5, 2)), rng)}
    found["c1"] = detections("c1", rng.uniform(0, 400, (last, 2)), rng)
    table = make_ray_table(rig, found, 0.0)
    row, rows = cell_at(table.rays, table.views, table.start, value, half)
    assert 0 <= row < rows


@pytest.mark.parametrize("blind", range(4))
def test_a_camera_without_detections_has_no_ray_in_any_point(blind):
    rig, rng = ring(4), np.random.default_rng(blind)
    targets = rng.uniform(-0.4, 0.4, (200, 3))
    found = {c.name: detections(c.name, project(c, targets), rng) for k, c in enumerate(rig.cameras) if k != blind}
    settings = MatchSettings(camera_sigma_px=0.0)
    points = match(make_ray_table(rig, found, 0.0), Predicted.nothing(), settings)
    assert len(points) > 100
    assert (points.rays[:, blind] == -1).all()
