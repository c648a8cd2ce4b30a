"""A vehicle's panel: a level sheet with a grid of flat targets, vibrating in its modes on a moving carrier.

Panel axes: x and y along the edges, z up, origin in the middle of the targets' plane. Each target goes up and down
with the sheet and turns with its slope. The sheet itself is drawn flat, ``BEHIND_M`` behind the targets, so that it
never hides one; its in-plane motion, of second order in the slope (1e-7 m here), is left out.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from mosca.data.arrays import Array, read_only, set_read_only
from mosca.errors import InputError
from twin.scenes.plate import ModalResponse, PlateModes, ThinPlate, random_response
from twin.scenes.scene import Scene
from twin.scenes.world import (
    FLAT_HALF_THICKNESS_M,
    Box,
    add_flat_target,
    add_shape,
    block,
    compiled,
    new_stage,
    positive,
)

BEHIND_M = 0.005
_MARGIN_S = 0.2  # a scene is defined a little before and after its capture
_SHAKE_HZ = (1.0, 12.0)
"""Band of a carrier's motion: a car body's bounce and pitch are at 1 to 2 Hz, its engine and axles at 8 to 15 Hz
(Wong, Theory of Ground Vehicles, chapter 7)."""
_WAVES = 8


@dataclass(frozen=True, eq=False)
class CarrierShake:
    """Rigid motion of the carrier: w waves for each of three displacements [m] and three small angles [rad]."""

    amplitude: Array
    """(w, 6)"""
    rate: Array
    """(w, 6) [rad/s]"""
    phase: Array
    """(w, 6)"""

    def __post_init__(self) -> None:
        set_read_only(self, amplitude=(None, 6), rate=(None, 6), phase=(None, 6))

    def __call__(self, time_s: float) -> Array:
        """Return displacements and angles (6,)."""
        return np.asarray((self.amplitude * np.sin(self.rate * time_s + self.phase)).sum(axis=0))


@dataclass(frozen=True, eq=False)
class PanelMotion:
    """qpos (6 + 3 m,): the carrier's displacements and angles, then the deflection and two slopes of each target."""

    modes: PlateModes
    response: ModalResponse
    shake: CarrierShake
    line_hz: float
    line_m: float
    """A steady line, such as an engine's order: frequency, and amplitude of the first mode's deflection."""
    mixing: Array
    """(3 m, k): deflection, dw/dy and -dw/dx of each target for a unit of each mode."""

    def __call__(self, time_s: float) -> Array:
        """Return qpos at session time ``time_s`` [s]."""
        q = self.response(time_s)
        q[0] += self.line_m * np.sin(2 * np.pi * self.line_hz * time_s)
        return np.concatenate([self.shake(time_s), self.mixing @ q])


def build_panel(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    size_m: tuple[float, float],
    plate: ThinPlate,
    damping: tuple[float, ...],
    grid: tuple[int, int],
    target_diameter_m: float,
    rms_m: float,
    band_hz: tuple[float, float],
    shake_m: float = 0.0,
    line_hz: float = 0.0,
    line_m: float = 0.0,
) -> Scene:
    """Return the panel, level in the middle of the working space, and its modes.

    Parameters
    ----------
    duration_s, box_center_m, box_size_m, rng
        Length of the scene, working space ((3,) each), and the generator that draws the forces.
    size_m, plate, damping
        Edges and plate of the sheet, and the damping of each of its lowest modes.
    grid, target_diameter_m
        Targets along x and y, in the middles of as many cells: P1..Pm, x fastest.
    rms_m, band_hz
        Rms deflection of all modes together, each where it is largest, and the band of the white forces.
    shake_m, line_hz, line_m
        Rigid motion (rms on each axis; its tilt moves the edges as far), and a steady line.

    Raises InputError where the panel does not fit the working space, or its targets the panel.
    """
    box = Box(box_center_m, box_size_m)
    positive({"duration_s": duration_s, "target_diameter_m": target_diameter_m, "rms_m": rms_m})
    if (np.array(size_m) > box.size[:2]).any():
        raise InputError(
            f"scene.size_m = {list(size_m)}: larger than working_space.size_m = {box.size.tolist()}; enlarge that"
        )
    edges, counts = np.array(size_m), np.array(grid)
    if target_diameter_m > 0.8 * (edges / counts).min():
        raise InputError(
            f"target_diameter_m = {target_diameter_m:g}: {grid[0]} x {grid[1]} targets on a panel of {size_m[0]:g} x "
            f"{size_m[1]:g} m touch; take fewer or smaller ones"
        )
    cells = np.stack(np.meshgrid(*(np.arange(k) for k in counts), indexing="xy"), axis=-1).reshape(-1, 2)
    xy = (cells + 0.5) * edges / counts
    modes = plate.modes(xy, len(damping), np.array(damping))
    response = random_response(modes, band_hz, rms_m, (-_MARGIN_S, duration_s + _MARGIN_S), rng)
    turns = np.stack([modes.shapes, modes.slopes[..., 1], -modes.slopes[..., 0]], axis=1)
    mixing = read_only(turns.reshape(-1, len(damping)), (None, len(damping)), "mixing")
    motion = PanelMotion(modes, response, _shake(shake_m, edges, rng), line_hz, line_m, mixing)
    names = tuple(f"P{k + 1}" for k in range(len(xy)))
    model, geoms = compiled(_specify(box, edges, names, xy - edges / 2, target_diameter_m), names)
    return Scene(model, names, geoms, motion, duration_s, modes=modes)


def _shake(rms_m: float, edges: Array, rng: np.random.Generator) -> CarrierShake:
    """Return motion of ``rms_m`` [m] on each axis, and angles that move the edges as far up and down."""
    angle = 2 * rms_m / np.array([edges[1], edges[0], edges.max()])
    amplitude = np.concatenate([np.full(3, rms_m), angle]) * np.sqrt(2 / _WAVES) * np.ones((_WAVES, 1))
    rate = 2 * np.pi * rng.uniform(*_SHAKE_HZ, (_WAVES, 6))
    return CarrierShake(amplitude, rate, rng.uniform(0, 2 * np.pi, (_WAVES, 6)))


def _specify(box: Box, edges: Array, names: tuple[str, ...], xy: Array, diameter: float) -> mujoco.MjSpec:
    spec = new_stage(floor=False)
    carrier = spec.worldbody.add_body(name="panel", pos=box.center)
    for kind in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE):
        for axis in np.eye(3):
            carrier.add_joint(type=kind, axis=axis)
    add_shape(carrier, block(np.array([0, 0, -BEHIND_M]), np.array([*edges, 0.001])), name="sheet", mass=1.0)
    up = np.array([0.0, 0.0, 1.0])
    for name, (x, y) in zip(names, xy, strict=True):
        body = carrier.add_body(name=name, pos=[x, y, 0.0])
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=up)
        for axis in np.eye(3)[:2]:
            body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        # a moving body must weigh something; nothing here is simulated
        body.mass, body.inertia, body.explicitinertial = 1e-3, [1e-6, 1e-6, 1e-6], True
        add_flat_target(body, name, -FLAT_HALF_THICKNESS_M * up, up, diameter)
    return spec
