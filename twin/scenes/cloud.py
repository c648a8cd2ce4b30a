"""Free ball markers all over a working space of any size, each on a smooth path of its own.

There is one marker in each cell of a lattice. It is offset from the cell's middle and oscillates by sums of
sinusoids, within ``LEEWAY`` of half a cell along each axis, so that no two markers come closer than (1 - LEEWAY) of
the shortest cell edge. The lattice as a whole rotates about the vertical and drifts, so that every marker crosses
many pixels; this does not change the distances.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from mosca.data.arrays import Array, read_only
from mosca.errors import InputError
from twin.scenes.scene import Scene
from twin.scenes.world import SEAT_M, Box, add_ball_marker, compiled, new_stage, positive

LEEWAY = 0.5
_OFFSET_SHARE = 0.4  # of the leeway: constant offset; the rest is motion
_TURN_RAD = np.deg2rad(15.0)
_DRIFT_SHARE = 0.05  # of each edge, to both sides
_WAVES = 3


@dataclass(frozen=True, eq=False)
class CloudPath:
    """Positions of n markers at any time [s], as qpos (3 n,): three slides for each marker from the box's centre."""

    cells: Array
    """(n, 3): mean positions in the lattice [m]."""
    amplitudes: Array
    """(w, n, 3): amplitudes of the markers' own waves [m]."""
    frequencies: Array
    """(w, n, 3) [rad/s]"""
    phases: Array
    """(w, n, 3)"""
    drift: Array
    """(3,): amplitude of the whole lattice's drift [m]."""
    drift_rate: Array
    """(3,) [rad/s]"""
    drift_phase: Array
    """(3,)"""
    turn_rate: float
    """Rotation of the whole lattice about the vertical [rad/s]."""
    turn_phase: float

    def __call__(self, time_s: float) -> Array:
        """Return qpos (3 n,) at session time ``time_s``."""
        waves = self.amplitudes * np.sin(self.frequencies * time_s + self.phases)
        local = self.cells + waves.sum(axis=0)
        angle = _TURN_RAD * np.sin(self.turn_rate * time_s + self.turn_phase)
        c, s = np.cos(angle), np.sin(angle)
        turned = local @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        shift = self.drift * np.sin(self.drift_rate * time_s + self.drift_phase)
        return np.asarray((turned + shift).reshape(-1))


def build_cloud(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    n: int = 200,
    marker_diameter_m: float | None = None,
    speed_mps: float | None = None,
    floor: bool = False,
) -> Scene:
    """Return ``n`` free ball markers P1..Pn in the working space.

    ``marker_diameter_m``: by default 1.2 % of the box's shortest edge. ``speed_mps``: rms speed of the
    markers, by default a fifth of the shortest edge a second. ``rng`` draws everything else. All markers
    stay inside the box. Raises InputError where markers of this size could touch.
    """
    box = Box(box_center_m, box_size_m)
    edge = float(box.size.min())
    diameter = 0.012 * edge if marker_diameter_m is None else marker_diameter_m
    speed = 0.2 * edge if speed_mps is None else speed_mps
    positive({"duration_s": duration_s, "marker_diameter_m": diameter, "speed_mps": speed, "n": n})
    counts, cell = _lattice(box, n, diameter)
    closest = closest_approach_m(box.size, n, diameter)
    if not closest > 1.2 * diameter:
        raise InputError(
            f"n = {n}, marker_diameter_m = {diameter:g}: in a box of {' x '.join(f'{e:g}' for e in box.size)} m "
            f"the markers come as close as {closest:.4g} m; take fewer or smaller ones, or a larger box"
        )
    path = _at_speed(_draw(box, counts, cell, n, rng), speed)
    names = tuple(f"P{k + 1}" for k in range(n))
    model, geoms = compiled(_specify(box, names, diameter, floor), names)
    return Scene(model, names, geoms, path, duration_s)


def closest_approach_m(box_size_m: Array, n: int, marker_diameter_m: float) -> float:
    """Return the lower bound of the distance between the centres of any two of ``n`` markers [m]."""
    _, cell = _lattice(Box(np.zeros(3), box_size_m), n, marker_diameter_m)
    return (1 - LEEWAY) * float(cell.min())


def _lattice(box: Box, n: int, diameter: float) -> tuple[Array, Array]:
    """Return how many cells (3,) along each axis and their edges (3,) [m]."""
    # The block of cells, rotated and at its largest drift, must stay inside the box.
    free = box.size * (1 - 2 * _DRIFT_SHARE) - diameter
    c, s = np.cos(_TURN_RAD), np.sin(_TURN_RAD)
    shrink = min(free[0] / (box.size[0] * c + box.size[1] * s), free[1] / (box.size[0] * s + box.size[1] * c))
    block = np.array([box.size[0] * shrink, box.size[1] * shrink, free[2]])
    if (block <= 0).any():
        raise InputError(f"marker_diameter_m = {diameter:g}: too large for a box of {box.size.tolist()} m")
    counts = np.ones(3, dtype=np.int64)
    while np.prod(counts) < n:
        counts[np.argmax(block / counts)] += 1  # splits the longest edge: cells stay near cubes
    return counts, block / counts


def _draw(box: Box, counts: Array, cell: Array, n: int, rng: np.random.Generator) -> CloudPath:
    places = np.stack(np.meshgrid(*(np.arange(k) for k in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    taken = np.sort(rng.permutation(len(places))[:n])
    middles = (places[taken] - (counts - 1) / 2) * cell
    leeway = LEEWAY * cell.min() / 2
    offsets = rng.uniform(-1, 1, (n, 3)) * leeway * _OFFSET_SHARE
    shares = rng.dirichlet(np.ones(_WAVES), (n, 3)).transpose(2, 0, 1)  # add up to 1: the leeway's bound
    return CloudPath(
        cells=read_only(middles + offsets, (n, 3), "cells"),
        amplitudes=read_only(shares * leeway * (1 - _OFFSET_SHARE), (_WAVES, n, 3), "amplitudes"),
        frequencies=read_only(rng.uniform(0.5, 2.0, (_WAVES, n, 3)), (_WAVES, n, 3), "frequencies"),
        phases=read_only(rng.uniform(0, 2 * np.pi, (_WAVES, n, 3)), (_WAVES, n, 3), "phases"),
        drift=read_only(_DRIFT_SHARE * box.size, (3,), "drift"),
        drift_rate=read_only(rng.uniform(0.3, 0.6, 3), (3,), "drift_rate"),
        drift_phase=read_only(rng.uniform(0, 2 * np.pi, 3), (3,), "drift_phase"),
        turn_rate=float(rng.uniform(0.3, 0.5)),
        turn_phase=float(rng.uniform(0, 2 * np.pi)),
    )


def _at_speed(path: CloudPath, speed_mps: float) -> CloudPath:
    """Return the same path played at such a rate that the markers' rms speed is ``speed_mps``."""
    times, step = np.linspace(0, 200, 400), 1e-4
    rates = [(path(t + step) - path(t)) / step for t in times]
    rms = float(np.sqrt(3 * np.mean(np.square(rates))))
    k = speed_mps / rms
    return CloudPath(
        path.cells,
        path.amplitudes,
        read_only(k * path.frequencies, path.frequencies.shape, "frequencies"),
        path.phases,
        path.drift,
        read_only(k * path.drift_rate, (3,), "drift_rate"),
        path.drift_phase,
        k * path.turn_rate,
        path.turn_phase,
    )


def _specify(box: Box, names: tuple[str, ...], diameter: float, floor: bool) -> mujoco.MjSpec:
    spec = new_stage(floor=floor)
    for name in names:
        body = spec.worldbody.add_body(name=name, pos=box.center)
        for axis in np.eye(3):
            body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        # A moving body must weigh something; nothing here is simulated.
        body.mass, body.inertia, body.explicitinertial = 1e-3, [1e-6, 1e-6, 1e-6], True
        # The ball's centre is the body's origin: undo the offset that seats a marker on a skin.
        normal = np.array([0.0, 0.0, 1.0])
        add_ball_marker(body, name, -(diameter / 2 + SEAT_M) * normal, normal, diameter)
    return spec
