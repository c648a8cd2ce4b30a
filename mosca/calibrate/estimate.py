"""Calibration from frames: the production entry point, whatever the target and wherever the frames come from."""

from dataclasses import dataclass, field

import numpy as np

from mosca.calibrate.interior import LensChoice
from mosca.calibrate.read_board import BoardReader
from mosca.calibrate.read_field import FieldReader
from mosca.calibrate.rigid import RigidSettings, RigidTarget, calibrate_rigid
from mosca.calibrate.sessions import MarkReader, Progress, sight
from mosca.data.boards import Board
from mosca.data.calibration import Calibration
from mosca.data.frames import FrameSource
from mosca.data.rig import Rig
from mosca.data.sightings import Sightings
from mosca.data.target_tables import CalibrationTarget
from mosca.data.targets import CodedTarget, RoundTarget, TestField
from mosca.errors import InputError


@dataclass(frozen=True)
class EstimateSettings:
    """``lens``: model to estimate; ``exterior_only``: keep the lenses of the known rig; ``every``: look at each so
    many-th frame set; ``reference``: frame set in which a rigid target is the world.
    """

    lens: LensChoice = field(default_factory=LensChoice)
    exterior_only: bool = False
    every: int = 1
    reference: int | None = None


def calibrate_frames(
    source: FrameSource,
    target: CalibrationTarget,
    settings: EstimateSettings | None = None,
    known: Rig | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate the cameras of a source whose frames show ``target``.

    ``known``: an earlier calibration of these cameras, to start from. InputError or CalibrationError, in one line,
    where the frames do not do.
    """
    settings = settings or EstimateSettings()
    sightings = sight(source, reader_of(target), settings.every, progress)
    return calibrate_sightings(sightings, target, settings, known)


def calibrate_sightings(
    sightings: Sightings, target: CalibrationTarget, settings: EstimateSettings, known: Rig | None = None
) -> Calibration:
    """Calibrate from what was seen of ``target``; see ``calibrate_frames``."""
    if isinstance(target, TestField | Board):
        rigid = RigidSettings(
            settings.lens, exterior_only=settings.exterior_only, reference=settings.reference
        )
        return calibrate_rigid(sightings, rigid_target(target), rigid, known)
    raise InputError(
        f"a {type(target).__name__} does not calibrate cameras; give a test field, a board or a wand"
    )


def reader_of(target: CalibrationTarget) -> MarkReader:
    """Return what finds a target's marks in an image."""
    if isinstance(target, TestField):
        return FieldReader(target)
    if isinstance(target, Board):
        return BoardReader(target)
    raise InputError(f"a {type(target).__name__} cannot be read mark by mark; give a test field or a board")


def rigid_target(target: TestField | Board) -> RigidTarget:
    """Return the marks of a test field or a board."""
    if isinstance(target, Board):
        return RigidTarget("board", target.corners(), target.sigma_m)
    return RigidTarget(
        "test field",
        target.positions,
        target.sigma_m,
        np.array([placed.normal for placed in target.targets]),
        np.array([_radius_m(placed.target) for placed in target.targets]),
    )


def _radius_m(target: object) -> float:
    match target:
        case CodedTarget(dot_radius_m=radius) | RoundTarget(radius_m=radius):
            return radius
    raise InputError("a test field holds coded targets and plain discs; balls belong on a wand or an L-frame")
