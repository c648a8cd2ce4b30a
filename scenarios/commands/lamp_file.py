"""The file of the lamps that worn cameras carry: ``mosca reconstruct --continuous --worn LAMPS.toml``."""

from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from mosca.continuous.moving_cameras.body_worn import Lamps
from mosca.data.files.toml import Positive, Table, Vector, check, read_toml
from mosca.data.lamp_codes import LAMP_NUMBERS
from mosca.data.rig import Rig
from mosca.errors import InputError


class LampSpec(Table):
    """A camera's lamp."""

    camera: str = Field(description="the camera that carries it")
    number: Annotated[int, Field(ge=0, lt=LAMP_NUMBERS)] = Field(description="number that it blinks")
    at_m: Vector = Field(description="where it is in the camera's frame (right, down, ahead) [m]")


class LampFile(Table):
    """Lamps of worn cameras, and the cameras whose poses the rig file has right: they are the frame and the metre."""

    FILE_KIND: ClassVar[str] = "lamps"

    bit_s: Positive = Field(description="how long a lamp shows a bit [s]")
    known: tuple[str, ...] = Field(description="cameras whose poses in the rig file are right, two or more")
    lamp: tuple[LampSpec, ...] = ()


def read_lamps(path: Path, rig: Rig) -> tuple[tuple[str, ...], Lamps]:
    """Return the cameras with known poses, and all cameras' lamps in the rig's order; InputError in one line."""
    file = check(LampFile, read_toml(path), path)
    for name in (*file.known, *(one.camera for one in file.lamp)):
        if name not in rig.names:
            raise InputError(f"{path}: camera '{name}' given; the rig has {', '.join(rig.names)}")
    if len(set(file.known)) < 2:
        raise InputError(f"{path}: known = {list(file.known)} given; two cameras or more are wanted")
    of_camera = {one.camera: one for one in file.lamp}
    for name in rig.names:
        if sum(one.camera == name for one in file.lamp) != 1:
            raise InputError(f"{path}: camera '{name}' needs one [[lamp]] table, no more and no less")
    own = [of_camera[name] for name in rig.names]
    numbers = tuple(one.number for one in own)
    if len(set(numbers)) < len(numbers):
        raise InputError(f"{path}: lamps' numbers are {list(numbers)}; each needs one of its own")
    return file.known, Lamps(numbers, np.array([one.at_m for one in own], dtype=float), file.bit_s)
