"""The file that defines rigid bodies, TOML.

::

    kind = "bodies"
    [[body]]
    name = "drone"
    sigma_m = 0.0002                      # standard deviation of a marker's place on each axis
    [[body.marker]]
    name = "D1"                           # becomes the track's label; by default drone/1, drone/2, ...
    position_m = [0.120, 0.045, 0.030]    # of the marker's centre in the body's own frame
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import tomli_w
from pydantic import Field

from mosca.data.bodies import FEWEST_MARKERS, MOST_MARKERS, RigidBody
from mosca.data.files.target_tables import Name, Place, Sigma
from mosca.data.files.toml import Table, check, read_toml
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError
from mosca.rigid_bodies.ambiguity import ALIKE_M, check_bodies


class BodyMarkerTable(Table):
    """``[[body.marker]]``: one ball of a body."""

    name: Name | None = None
    position_m: Place = Field(description="[x, y, z] of the marker's centre in the body's frame")


class BodyTable(Table):
    """``[[body]]``: one rigid body."""

    name: Name
    sigma_m: Sigma = 0.0
    marker: Annotated[
        tuple[BodyMarkerTable, ...],
        Field(min_length=FEWEST_MARKERS, max_length=MOST_MARKERS, description="[[body.marker]] tables"),
    ]

    def made(self) -> RigidBody:
        """Return the body; ValueError for one that leaves its pose open."""
        names = tuple(one.name or f"{self.name}/{k}" for k, one in enumerate(self.marker, 1))
        return RigidBody(self.name, names, np.array([one.position_m for one in self.marker]), self.sigma_m)


class BodiesTable(Table):
    """The whole file."""

    FILE_KIND: ClassVar[str] = "bodies"

    kind: Literal["bodies"] = Field(description='"bodies"')
    body: Annotated[tuple[BodyTable, ...], Field(min_length=1, description="[[body]] tables")]


def read_bodies(path: Path, alike_m: float = ALIKE_M) -> tuple[RigidBody, ...]:
    """Read the rigid bodies that a TOML file defines.

    Raises InputError naming key, value and what is allowed. For bodies that are nearly symmetric or nearly congruent
    it states by how many mm they differ, and what to move.
    """
    path = Path(path)
    table = check(BodiesTable, read_toml(path), path)
    try:
        bodies = tuple(one.made() for one in table.body)
        check_bodies(bodies, alike_m)
    except (ValueError, InputError) as error:
        raise InputError(f"{path}: {error}") from None
    return bodies


def write_bodies(bodies: Sequence[RigidBody], path: Path) -> None:
    """Write the definitions of ``bodies``, every number at full precision, whole or not at all.

    Raises InputError where the file cannot be written or would not be read back (names, positions).
    """
    document: dict[str, Any] = {
        "kind": "bodies",
        "body": [
            {
                "name": body.name,
                "sigma_m": body.sigma_m,
                "marker": [
                    {"name": name, "position_m": place}
                    for name, place in zip(body.markers, body.positions.tolist(), strict=True)
                ],
            }
            for body in bodies
        ],
    }
    check(BodiesTable, document, path)
    write_text(Path(path), tomli_w.dumps(document))
