"""The file of a marker model, TOML: which markers a subject carries and how far they are from each other.

::

    kind = "marker-model"
    markers = ["LFHD", "RFHD", "LBHD", "C7"]
    links = [                             # two markers, their distance and how much it changes (std. deviation) [m]
      ["LFHD", "RFHD", 0.1512, 0.0041],
    ]
    sides = [                             # four markers and the volume (b - a) x (c - a) . (d - a) [m^3] that
      ["LFHD", "RFHD", "LBHD", "C7", 0.0002],     # keeps its sign: distinguishes left from right
    ]
    [limbs]                               # where they are known
    head = ["LFHD", "RFHD", "LBHD"]

A pair without a link was never observed together.
"""

import re
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import tomli_w
from pydantic import Field, model_validator

from mosca.data.files.toml import NotNegative, Positive, Table, check, read_toml
from mosca.data.files.whole_file import write_text
from mosca.labelling.marker_model import SOFT_M, MarkerModel

MOST_MARKERS = 1000

Name = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f]+$")]
"""Any label: those of other programs contain blanks and colons."""
Link = tuple[Name, Name, NotNegative, Positive]
Side = tuple[Name, Name, Name, Name, float]


class ModelTable(Table):
    """The whole file."""

    FILE_KIND: ClassVar[str] = "marker-model"

    kind: Literal["marker-model"] = Field(description='"marker-model"')
    markers: Annotated[
        tuple[Name, ...], Field(min_length=3, max_length=MOST_MARKERS, description="names, become labels")
    ]
    links: Annotated[
        tuple[Link, ...], Field(min_length=1, description="[marker, marker, distance m, its standard deviation m]")
    ]
    sides: tuple[Side, ...] = Field((), description="[marker, marker, marker, marker, signed volume m^3]")
    limbs: dict[str, tuple[Name, ...]] = Field({}, description="limb = its markers")

    @model_validator(mode="after")
    def _consistent(self) -> "ModelTable":
        known = set(self.markers)
        if len(known) < len(self.markers):
            twice = next(name for name in self.markers if self.markers.count(name) > 1)
            raise ValueError(f"marker '{twice}' stands twice in markers; names must differ")
        pairs = set()
        for a, b, _, _ in self.links:
            _check_markers("links", (a, b), known)
            if frozenset((a, b)) in pairs:
                raise ValueError(f"links: '{a}' and '{b}' stand twice; give each pair once")
            pairs.add(frozenset((a, b)))
        for *four, volume in self.sides:
            _check_markers("sides", tuple(str(name) for name in four), known)
            if volume == 0.0:
                raise ValueError(f"sides: {', '.join(map(str, four))} have volume 0, which tells no side")
        for limb, members in self.limbs.items():
            _check_markers(f"limb '{limb}'", members, known)
        return self

    def made(self) -> MarkerModel:
        """Return the model."""
        row = {name: k for k, name in enumerate(self.markers)}
        n = len(row)
        mean, sigma = np.full((n, n), np.nan), np.full((n, n), np.nan)
        np.fill_diagonal(mean, 0.0)
        np.fill_diagonal(sigma, SOFT_M)
        for a, b, distance, spread in self.links:
            mean[row[a], row[b]] = mean[row[b], row[a]] = distance
            sigma[row[a], row[b]] = sigma[row[b], row[a]] = spread
        quads = np.array([[row[name] for name in side[:4]] for side in self.sides], np.int64).reshape(-1, 4)
        volumes = np.array([side[4] for side in self.sides], float)
        return MarkerModel(self.markers, mean, sigma, quads, volumes, dict(self.limbs))


def read_model(path: Path) -> MarkerModel:
    """Read a marker model. Raises InputError naming file, key, value and what is allowed."""
    path = Path(path)
    return check(ModelTable, read_toml(path), path).made()


def write_model(model: MarkerModel, path: Path) -> None:
    """Write ``model``, every number at full precision, whole or not at all.

    Raises InputError where the file cannot be written or would not be read back (names).
    """
    names = list(model.names)
    document: dict[str, Any] = {
        "kind": "marker-model",
        "markers": names,
        "links": [
            [names[i], names[j], float(model.mean_m[i, j]), float(model.sigma_m[i, j])]
            for i in range(len(names))
            for j in range(i + 1, len(names))
            if np.isfinite(model.mean_m[i, j]) and np.isfinite(model.sigma_m[i, j])
        ],
        "sides": [
            [*(names[k] for k in four), float(volume)]
            for four, volume in zip(model.quads.tolist(), model.volume_m3.tolist(), strict=True)
        ],
    }
    if model.limbs:
        document["limbs"] = {limb: list(members) for limb, members in model.limbs.items()}
    check(ModelTable, document, path)
    write_text(Path(path), _rows(tomli_w.dumps(document, indent=2)))


def model_schema() -> dict[str, Any]:
    """Return the JSON schema of marker-model files."""
    return ModelTable.model_json_schema()


def _check_markers(where: str, names: tuple[str, ...], known: set[str]) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"{where}: '{name}' is not one of markers; add it there or mend the name")
    if len(set(names)) < len(names):
        raise ValueError(f"{where}: {', '.join(names)}: a marker stands twice; they must differ")


def _rows(text: str) -> str:
    """Return the TOML with each link and side on one line of its own."""

    def row(found: re.Match[str]) -> str:
        cells = " ".join(cell.strip() for cell in found[1].split("\n")[:-1])
        return f"  [{cells.removesuffix(',')}],"

    return re.sub(r"^  \[\n((?:    .*\n)+)  \],$", row, text, flags=re.MULTILINE)
