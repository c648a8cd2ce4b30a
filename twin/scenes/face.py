"""A head that speaks: a deforming face with 40 ball markers, moved by blend shapes and turned as speakers do.

The head is a free body. Each marker sits on a body of its own, which slides on the head by the blend shapes
(``face_surface``); a disc of skin beneath it hides it from behind. Skull, nose and jaw are ellipsoids some
millimetres below the skin; that of the jaw turns with it. The skin between the discs does not occlude.

Coefficients are sums of sinusoids drawn in a band. Lips and jaw: 2 to 7 Hz, in which the opening of the mouth is
modulated in speech (Chandrasekaran et al. 2009, PLoS Comput Biol 5, e1000436), with an amplitude that rises and falls
with phrases; brows, eyes and nose: 0.2 to 1.5 Hz. The head sways by some centimetres and 10 degrees.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from mosca.data.arrays import Array, read_only
from mosca.errors import InputError
from twin.scenes.face_surface import JAW_RAD, SHAPES, BlendShapes, FaceSurface, markers_on_front
from twin.scenes.scene import Scene
from twin.scenes.soft_tissue import SLIDES, add_slides
from twin.scenes.target_motion import CarriedPath, carried_body, carried_by_hand
from twin.scenes.target_plate import add_ball_at
from twin.scenes.world import Box, add_shape, compiled, ellipsoid, new_stage, positive

_BANDS_HZ = {"speech": (2.0, 7.0), "mimic": (0.2, 1.5), "phrase": (0.1, 0.5)}
_WAVES = 12
_SWING_M = np.array([0.02, 0.02, 0.015])
_SWAY_RAD = np.deg2rad([8.0, 10.0, 12.0])
_SPEED_MPS, _TURN_RAD_S = 0.05, 0.35
_MIDDLE_M = np.array([0.065, 0.0, -0.012])
"""Middle of the markers, head axes; it is placed over the middle of the working space."""
_DISC_M = 0.006
_DISC_HALF_M = 0.001


@dataclass(frozen=True, eq=False)
class SpeakingHead:
    """The configuration at any time of a head whose face moves."""

    head: CarriedPath
    shapes: BlendShapes
    slides: Array
    """(m, 3): addresses in qpos."""
    places: tuple[int, int]
    """Addresses of head and jaw in qpos."""
    rates: Array
    """(s + 1, w): frequencies of the coefficients' waves, and of those of the phrases [rad/s]."""
    phases: Array
    """(s + 1, w)"""
    nq: int

    def coefficients(self, time_s: float) -> Array:
        """Return the blend shapes' coefficients (s,), 0 to 1, at ``time_s`` [s]."""
        waves = np.sqrt(2.0 / _WAVES) * np.sin(self.rates * time_s + self.phases).sum(axis=1)
        phrase = 0.5 * (1.0 + np.tanh(1.5 * waves[-1] + 1.0))
        share = np.array([phrase if moves == "speech" else 1.0 for _, moves, _ in SHAPES])
        # 0.3 on average, since a face is nearer to rest than to the end of a movement
        return np.asarray(share * 0.5 * (1.0 + np.tanh(0.6 * waves[:-1] - 0.5)))

    def __call__(self, time_s: float) -> Array:
        """Return qpos (nq,) at session time ``time_s`` [s]."""
        value = self.coefficients(time_s)
        qpos = np.zeros(self.nq)
        qpos[self.places[0] : self.places[0] + 7] = self.head(time_s)
        qpos[self.places[1]] = JAW_RAD * value[0]
        qpos[self.slides] = self.shapes.moved(value)
        return qpos


def build_face(
    *,
    duration_s: float,
    box_center_m: Array,
    box_size_m: Array,
    rng: np.random.Generator,
    size: float = 1.0,
    seat_sigma_m: float = 0.002,
    marker_diameter_m: float = 0.003,
) -> Scene:
    """Return a head that looks along +x and speaks, with 40 ball markers on its face, in a working space.

    ``size``: ratio of the head to that of the mean adult; ``seat_sigma_m``: distance of markers from the layout's
    places, sideways and up (one sigma each); ``rng`` draws the person and the movement. InputError where the space is
    too small.
    """
    positive({"duration_s": duration_s, "size": size, "marker_diameter_m": marker_diameter_m})
    if not 0.7 <= size <= 1.3:
        raise InputError(f"size = {size:g} given; 0.7 to 1.3 times an adult's mean is wanted")
    box = Box(box_center_m, box_size_m)
    person, moves = rng.spawn(2)
    face = FaceSurface.drawn(size, person)
    names, yz = markers_on_front()
    yz = yz + 1e3 * seat_sigma_m * person.normal(size=yz.shape)
    skin, normal = face.placed(face.skin(yz)), face.normals(yz)
    middle = size * _MIDDLE_M
    model, geoms = _compiled(face, names, skin, normal, marker_diameter_m)
    head = carried_by_hand(
        _SWING_M, center=box.center - middle, rotation=np.eye(3), sway_rad=_SWAY_RAD, speed_mps=_SPEED_MPS,
        turn_rad_s=_TURN_RAD_S, spin=0.0, rng=moves,
    )  # fmt: skip
    bands = np.array([_BANDS_HZ[kind] for kind in (*(moved for _, moved, _ in SHAPES), "phrase")])
    drawn = 2 * np.pi * moves.uniform(bands[:, :1], bands[:, 1:], (len(bands), _WAVES))
    joints = [[f"{SLIDES}{name}/{axis}" for axis in "xyz"] for name in names]
    slides = [[_address(model, joint) for joint in of_marker] for of_marker in joints]
    path = SpeakingHead(
        head,
        BlendShapes.of(face, yz),
        read_only(np.array(slides), (len(names), 3), "slides", np.int64),
        (_address(model, "head"), _address(model, "jaw")),
        read_only(drawn, (len(bands), _WAVES), "rates"),
        read_only(moves.uniform(0, 2 * np.pi, drawn.shape), drawn.shape, "phases"),
        int(model.nq),
    )
    scene = Scene(model, names, geoms, path, duration_s)
    _check_inside(scene, box)
    return scene


def _check_inside(scene: Scene, box: Box) -> None:
    """Raise InputError where a marker leaves the box, which is tested ten times a second."""
    sampler = scene.sampler()
    xyz = np.array([sampler.at(t).marker_xyz for t in np.arange(0.0, scene.duration_s, 0.1)])
    if (xyz < box.low).any() or (xyz > box.high).any():
        needs = 2 * np.abs(xyz - box.center).max(axis=(0, 1))
        raise InputError(
            f"box_size_m = {box.size.tolist()}: too small for this face as it moves, which needs "
            f"{' x '.join(f'{e:.3f}' for e in needs)} m; enlarge the box"
        )


def _address(model: mujoco.MjModel, joint: str) -> int:
    return int(model.joint(joint).qposadr[0])


def _compiled(
    face: FaceSurface, names: tuple[str, ...], skin: Array, normal: Array, diameter: float
) -> tuple[mujoco.MjModel, tuple[int, ...]]:
    spec = new_stage(floor=False)
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-9
    head = carried_body(spec, "head")
    jaw = head.add_body(name="jaw")
    jaw.add_joint(name="jaw", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], pos=face.jaw_joint)
    for name, body, center, semi_axes in (
        ("skull", head, [-7.0, 0.0, 22.0], [86.0, 66.0, 76.0]),
        ("nose", head, [84.0, 0.0, -12.0], [24.0, 8.0, 16.0]),
        ("chin", jaw, [20.0, 0.0, -48.0], [62.0, 50.0, 46.0]),
    ):
        add_shape(body, ellipsoid(face.placed(np.array(center)), face.placed(np.array(semi_axes))), name=name)
    gap = np.linalg.norm(skin[:, None] - skin, axis=2)
    np.fill_diagonal(gap, np.inf)
    for k, name in enumerate(names):
        holder = add_slides(head, name)
        # discs do not reach a neighbour's ball
        radius = min(_DISC_M, 0.5 * float(gap[k].min()) - diameter / 2)
        disc = ellipsoid(skin[k] - _DISC_HALF_M * normal[k], np.array([radius, radius, _DISC_HALF_M]), normal[k])
        add_shape(holder, disc, name=f"disc/{name}", mass=1e-6)
        add_ball_at(holder, name, skin[k] + diameter / 2 * normal[k], diameter)
    return compiled(spec, names)
