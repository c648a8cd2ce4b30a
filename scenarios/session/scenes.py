"""Scenes of a calibration session, with the target described by its file."""

from dataclasses import dataclass, replace
from typing import Any, Generic

import numpy as np

from mosca.calibration.session import Target_co
from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.files.target_tables import CalibrationTarget
from mosca.data.target_codes import NUMBERS
from mosca.data.targets import CodedTarget, PlacedTarget, ScaleBar, TestField, face_axes
from mosca.data.wands import LFrame, Wand
from scenarios.spec.calibration import CalibrationSpec, WrongSizeFault, WrongUnitsFault
from scenarios.spec.scenario import Scenario
from twin.scenes.field_layout import LaidOutField, lay_out_field
from twin.scenes.scene import Scene
from twin.scenes.target_boards import build_board
from twin.scenes.target_field import field_scene
from twin.scenes.target_motion import put_from_stand_to_stand
from twin.scenes.target_wand import build_l_frame, build_scale_bar, build_wand, default_l_frame
from twin.scenes.world import Box
from twin.streams import rng

AXES_FRAMES, BAR_FRAMES = 40, 60
BOARD_COLUMNS, BOARD_ROWS = 9, 6
BOARD_SHARE, WAND_SHARE, BAR_SHARE = 0.5, 0.4, 0.3
"""Length of board, wand and bar over the working space's shortest edge."""
FIELD_SHARE = 1.1
"""Edges of a field over those of the working space, so that its marks enclose the measured volume."""
SPEED_SHARE = 0.3
"""Speed of a target carried by hand: shares of the working space's longest edge a second."""


@dataclass(frozen=True, eq=False)
class Session(Generic[Target_co]):
    """A scene, its number of exposures, and the target described by its file, with the file's errors."""

    scene: Scene
    pulses: int
    target: Target_co


def target_session(spec: Scenario, wanted: CalibrationSpec) -> Session[CalibrationTarget]:
    """Return the session of the calibration target."""
    if wanted.target == "field":
        return _field(spec, wanted)
    return _board(spec, wanted) if wanted.target == "board" else _wand(spec, wanted)


def axes_session(spec: Scenario) -> Session[LFrame]:
    """Return the L-frame that defines the world's axes, at the bottom of the working space."""
    where = _where(spec, AXES_FRAMES)
    box = Box(where["box_center_m"], where["box_size_m"])
    frame = default_l_frame(box)
    scene = build_l_frame(**where, l_frame=frame, floor=False)
    places = scene.sampler().at(0.0).marker_xyz
    return Session(scene, AXES_FRAMES, LFrame(frame.names, places, frame.diameter_m))


def bar_session(spec: Scenario) -> Session[ScaleBar]:
    """Return a certified scale bar, carried about."""
    where = _where(spec, BAR_FRAMES)
    length = BAR_SHARE * float(where["box_size_m"].min())
    dot = 0.045 * length
    bar = ScaleBar(length, 1e-5 * length, (CodedTarget.of_dot(0, dot), CodedTarget.of_dot(1, dot)))
    draw = rng(spec.seed, "calibration/bar")
    speed = SPEED_SHARE * float(where["box_size_m"].max())
    scene = build_scale_bar(**where, bar=bar, rng=draw, speed_mps=speed, turn_rad_s=1.5, floor=False)
    return Session(scene, BAR_FRAMES, bar)


def _field(spec: Scenario, wanted: CalibrationSpec) -> Session[TestField]:
    draw = rng(spec.seed, "calibration")
    size = np.array(wanted.size_m or FIELD_SHARE * np.array(spec.working_space.size_m))
    center = np.array(spec.working_space.center_m)
    if wanted.layout == "plate":
        laid = _plate(size, wanted.markers, wanted.relief, draw)
    else:
        laid = lay_out_field(size, draw, n=wanted.markers, layout=wanted.layout)
    rate_hz, exposure_s = wanted.rate_hz, spec.capture.exposure_s
    hold_s = wanted.frames / rate_hz
    more = max(wanted.world_frames - wanted.frames, 0)
    path = put_from_stand_to_stand(
        center,
        wanted.stands,
        hold_s,
        lead_s=(1 / rate_hz - exposure_s) / 2,
        shift_m=wanted.shift * size,
        tilt_rad=np.deg2rad(wanted.tilt_deg),
        rng=draw,
        first_s=more / rate_hz,
    )
    exposures = wanted.frames * wanted.stands + more
    scene = field_scene(laid, path, exposures / rate_hz, origin=np.zeros(3), floor=False)
    sigma = wanted.known_to * float(size.max())
    measured = tuple(
        replace(one, position=one.position + center + sigma * draw.standard_normal(3)) for one in laid.field.targets
    )
    return Session(scene, exposures, _believed(TestField(measured, sigma), wanted))


def _believed(field: TestField, wanted: CalibrationSpec) -> TestField:
    """Return the field described by a file with the scenario's fault."""
    factor = _length_factor(wanted)
    if factor is None:
        return field
    dots = 1.0 if isinstance(wanted.fault, WrongUnitsFault) else factor
    targets = tuple(replace(one, position=one.position * factor, target=_scaled(one, dots)) for one in field.targets)
    return TestField(targets, field.sigma_m * factor)


def _length_factor(wanted: CalibrationSpec) -> float | None:
    """Return the factor of the lengths in the target's file over the true ones; None where the file is right."""
    if isinstance(wanted.fault, WrongUnitsFault):
        return wanted.fault.factor
    return 1 / wanted.fault.factor if isinstance(wanted.fault, WrongSizeFault) else None


def _scaled(placed: PlacedTarget, factor: float) -> CodedTarget:
    assert isinstance(placed.target, CodedTarget)
    return CodedTarget.of_dot(placed.target.number, placed.target.dot_radius_m * factor)


def _plate(size: Array, n: int, relief: float, draw: np.random.Generator) -> LaidOutField:
    """Return targets in rows on an upright plate that faces +x, up to ``relief`` in front of it."""
    columns = int(np.ceil(np.sqrt(n * size[1] / size[2])))
    rows = int(np.ceil(n / columns))
    cell = min(size[1] / columns, size[2] / rows)
    numbers = draw.permutation(NUMBERS)[:n]
    axes = face_axes(np.array([1.0, 0.0, 0.0]))
    targets = []
    for k, number in enumerate(numbers):
        row, column = divmod(k, columns)
        along = np.array([(column + 0.5) / columns - 0.5, 0.5 - (row + 0.5) / rows]) * size[1:]
        depth = relief * float(size[1:].max()) * draw.uniform(-0.5, 0.5)
        place = axes @ np.array([along[0], along[1], depth])
        targets.append(
            PlacedTarget(f"code/{number:03d}", CodedTarget.of_dot(int(number), 0.1 * cell), place, axes[:, 2])
        )
    return LaidOutField(TestField(tuple(targets)), ())


def _board(spec: Scenario, wanted: CalibrationSpec) -> Session[Board]:
    where = _where(spec, wanted.frames, wanted.size_m)
    square = BOARD_SHARE * min(spec.working_space.size_m) / BOARD_COLUMNS
    board = Board(BOARD_COLUMNS, BOARD_ROWS, square, square)
    speed = SPEED_SHARE * float(where["box_size_m"].max())
    scene = build_board(
        **where,
        rng=rng(spec.seed, "calibration"),
        board=board,
        speed_mps=speed,
        turn_rad_s=0.9,
        facing=None,
        tilt_rad=np.deg2rad(34.0),
        floor=False,
    )
    described = replace(board, sigma_m=wanted.known_to * square * BOARD_COLUMNS)
    if (factor := _length_factor(wanted)) is not None:
        described = replace(described, square_m=square * factor, margin_m=square * factor)
    return Session(scene, wanted.frames, described)


def _wand(spec: Scenario, wanted: CalibrationSpec) -> Session[Wand]:
    where = _where(spec, wanted.frames, wanted.size_m)
    edge = min(spec.working_space.size_m)
    length = WAND_SHARE * edge
    wand = Wand((0.0, 0.35 * length, length), 0.02 * edge)
    speed = 2 * SPEED_SHARE * float(where["box_size_m"].max())
    scene = build_wand(
        **where, rng=rng(spec.seed, "calibration"), wand=wand, speed_mps=speed, turn_rad_s=2.0, floor=False
    )
    along = tuple(x * (_length_factor(wanted) or 1.0) for x in wand.along_m)
    return Session(scene, wanted.frames, Wand(along, wand.diameter_m, wanted.known_to * length))


def _where(spec: Scenario, pulses: int, size_m: tuple[float, float, float] | None = None) -> dict[str, Any]:
    """Return duration and box of a target's motion: the working space, or a box of ``size_m`` at its centre."""
    space = spec.working_space
    assert spec.calibration is not None
    return {
        "duration_s": pulses / spec.calibration.rate_hz,
        "box_center_m": np.array(space.center_m),
        "box_size_m": np.array(size_m or space.size_m),
    }
