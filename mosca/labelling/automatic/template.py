"""A marker-set template: segments of a generic person, and the usual places of markers on them.

It is read from a TOML file (``full_body.toml`` describes its keys). ``expectation`` estimates from drawn persons how
poses and body sizes change the distances between markers.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.files.toml import Positive, Table, Vector, check, read_toml
from mosca.errors import InputError

STANDARD = Path(__file__).with_name("full_body.toml")
MOST_MARKERS = 200
PERSONS, POSES = 60, 24
"""Number of persons drawn for an expectation, and of poses of each."""
SEED = 0
IN_A_SET = 0.97
"""Share of takes that show a marker of a set that is worn; the rest show one that is not in the set."""

Name = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f]+$")]
Share = Annotated[float, Field(gt=0, lt=1)]
Range = tuple[Annotated[float, Field(ge=-180, le=0)], Annotated[float, Field(ge=0, le=180)]]


class TemplateSegment(Table):
    """A limb, or a part of the trunk."""

    name: Name
    other_side: Name | None = Field(None, description="segment that is its mirror image in y = 0")
    parent: Name | None = Field(None, description="segment it turns on, listed before it; the first has none")
    joint_m: Vector = Field(description="where it turns on its parent [m]")
    turn_deg: tuple[Range, Range, Range] = Field(
        ((0, 0), (0, 0), (0, 0)), description="range of motion about x, y and z, 0 for the pose of the template"
    )


class TemplateMarker(Table):
    """A marker of the set."""

    name: Name
    other_side: Name | None = Field(None, description="marker that is its mirror image in y = 0")
    segment: Name = Field(description="segment that carries it")
    place_m: Vector = Field(description="its place [m]")
    spread_m: tuple[Positive, Positive, Positive] = Field(
        (0.02, 0.02, 0.02), description="standard deviation of its place along x, y, z [m]"
    )
    share: Share = Field(IN_A_SET, description="share of takes that show it")
    beside: Name | None = Field(None, description="marker without which nobody wears it")


class TemplateTable(Table):
    """The whole file."""

    FILE_KIND: ClassVar[str] = "marker-template"

    kind: Literal["marker-template"] = Field(description='"marker-template"')
    height_m: Positive = Field(description="of the person [m]")
    segment: Annotated[tuple[TemplateSegment, ...], Field(min_length=1, max_length=MOST_MARKERS)]
    marker: Annotated[tuple[TemplateMarker, ...], Field(min_length=4, max_length=MOST_MARKERS)]
    sets: dict[str, tuple[Name, ...]] = Field({}, description="set = its markers, with those of the other side")
    names: dict[str, dict[str, Name]] = Field({}, description="set = what it calls markers by other names")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        segments: list[str] = []
        for one in self.segment:
            if (one.parent is None) != (not segments):
                raise ValueError(f"segment '{one.name}': the first segment, and no other, has no parent")
            if one.parent is not None and one.parent not in segments:
                raise ValueError(f"segment '{one.name}': parent '{one.parent}' is not listed before it")
            segments += [name for name in (one.name, one.other_side) if name is not None]
        if self.segment[0].other_side is not None:
            raise ValueError(f"segment '{segments[0]}': the first segment has no other side")
        markers = [name for one in self.marker for name in (one.name, one.other_side) if name is not None]
        for names in (segments, markers):
            if len(set(names)) < len(names):
                raise ValueError(
                    f"'{next(n for n in names if names.count(n) > 1)}' is named twice; names must differ"
                )
        if unknown := next((one for one in self.marker if one.segment not in segments), None):
            raise ValueError(f"marker '{unknown.name}': its segment '{unknown.segment}' is not listed")
        if alone := next((one for one in self.marker if one.beside not in (None, *markers)), None):
            raise ValueError(f"marker '{alone.name}': beside '{alone.beside}', which is not listed")
        for where in (self.sets, self.names):
            for title, those in where.items():
                if unknown_name := next((name for name in those if name not in markers), None):
                    raise ValueError(f"set '{title}': marker '{unknown_name}' is not listed")
        return self


@dataclass(frozen=True)
class BodyVariation:
    """How people differ, as shares of a length (standard deviations)."""

    stature: float = 0.07
    """Statures of adults: 4 % within a sex, and 7 % between them (NHANES: 1.62 and 1.76 m, both 0.07 m)."""
    segment: float = 0.05
    """Segment lengths at one stature (Winter states means only; textbooks give 4 to 6 %)."""


@dataclass(frozen=True, eq=False)
class TemplateSet:
    """A marker set, as one of several that a person may wear."""

    title: str
    names: tuple[str, ...]
    """(m) its names of the template's markers."""
    share: Array
    """(m,) share of takes that show each."""


@dataclass(frozen=True, eq=False)
class MarkerTemplate:
    """Markers (m) on segments (g) of a generic person."""

    names: tuple[str, ...]
    segment: Array
    """(m,) index of the segment that carries each."""
    place_m: Array
    """(m, 3) places in a standing person [m]; x forward, y left, z up."""
    spread_m: Array
    """(m, 3) standard deviations of the places [m]."""
    share: Array
    """(m,) share of takes that show it."""
    other_side: Array
    """(m,) index of its mirror image, or its own."""
    beside: Array
    """(m,) index of the marker without which it is not worn, -1 where there is none."""
    segment_names: tuple[str, ...]
    parent: Array
    """(g,) -1 of the first."""
    joint_m: Array
    """(g, 3)"""
    turn_rad: Array
    """(g, 3, 2) ranges about x, y, z."""
    sets: tuple[TemplateSet, ...] = ()
    """Sets that the person may wear; none where the set is known."""
    variation: BodyVariation = BodyVariation()
    """Variation of the person's sizes about the template's."""

    def called(self, set_name: str) -> tuple[str, ...]:
        """Return the markers' names in a set; the template's own names for ""."""
        return next((one.names for one in self.sets if one.title == set_name), self.names)


def read_template(path: Path = STANDARD, set_name: str | None = None) -> MarkerTemplate:
    """Return the template in ``path``, restricted to one set if given; InputError where the file or set is wrong."""
    return template_of(check(TemplateTable, read_toml(path), path), set_name, path)


def template_of(file: TemplateTable, set_name: str | None, where: str | Path) -> MarkerTemplate:
    """Return a template with both sides, of one set or of all markers; InputError for an unknown set."""
    if set_name is not None and set_name not in file.sets:
        raise InputError(f"{where}: set '{set_name}' given; it has {', '.join(file.sets) or 'none'}")
    segments: list[tuple[str, TemplateSegment, bool]] = []
    for one in file.segment:
        segments += [(one.name, one, False)] + ([(one.other_side, one, True)] if one.other_side else [])
    numbers = {name: k for k, (name, _, _) in enumerate(segments)}
    other = {one.name: one.other_side or one.name for one in file.segment}
    turns = np.radians([one.turn_deg for _, one, _ in segments])
    mirrored = np.array([side for _, _, side in segments])
    # a mirror image turns the other way about the axes in the mirror
    turns[mirrored] = np.stack([-turns[mirrored, 0, ::-1], turns[mirrored, 1], -turns[mirrored, 2, ::-1]], axis=1)
    flip = np.array([1.0, -1.0, 1.0])
    parents = [
        -1 if one.parent is None else numbers[other.get(one.parent, one.parent) if side else one.parent]
        for _, one, side in segments
    ]
    markers: list[tuple[str, TemplateMarker, bool]] = []
    for mark in file.marker:
        markers += [(mark.name, mark, False)] + ([(mark.other_side, mark, True)] if mark.other_side else [])
    if set_name is not None:
        chosen = _members(file, set_name)
        markers = [row for row in markers if row[0] in chosen]
        if len(markers) < 4:
            raise InputError(f"{where}: set '{set_name}' has {len(markers)} markers; 4 or more are wanted")
    at = {name: k for k, (name, _, _) in enumerate(markers)}
    called = file.names.get(set_name or "", {})
    mates = [(mark.name if side else mark.other_side or mark.name) for _, mark, side in markers]
    return MarkerTemplate(
        tuple(called.get(name, name) for name, _, _ in markers),
        np.array([numbers[other.get(m.segment, m.segment) if side else m.segment] for _, m, side in markers]),
        np.array([np.array(m.place_m) * (flip if side else 1.0) for _, m, side in markers]),
        np.array([m.spread_m for _, m, _ in markers]),
        np.array([m.share if set_name is None else IN_A_SET for _, m, _ in markers]),
        np.array([at.get(mate, k) for k, mate in enumerate(mates)]),
        np.array([at.get(_mirrored(file, m.beside) if side else m.beside or "", -1) for _, m, side in markers]),
        tuple(name for name, _, _ in segments),
        np.array(parents),
        np.array([np.array(one.joint_m) * (flip if side else 1.0) for _, one, side in segments]),
        turns,
        () if set_name is not None else tuple(_set_of(file, title, list(at)) for title in file.sets),
    )


def _mirrored(file: TemplateTable, name: str | None) -> str:
    """Return the mirror image of a marker."""
    other = {mark.name: mark.other_side for mark in file.marker if mark.other_side is not None}
    other |= {mate: own for own, mate in other.items()}
    return other.get(name or "", name or "")


def _members(file: TemplateTable, title: str) -> set[str]:
    """Return the markers of a set, of both sides."""
    both = {mark.name: mark.other_side for mark in file.marker}
    return {n for name in file.sets[title] for n in (name, both.get(name)) if n is not None}


def _set_of(file: TemplateTable, title: str, names: list[str]) -> TemplateSet:
    members, called = _members(file, title), file.names.get(title, {})
    share = np.where([name in members for name in names], IN_A_SET, 1 - IN_A_SET)
    return TemplateSet(title, tuple(called.get(name, name) for name in names), share)


@dataclass(frozen=True, eq=False)
class Expectation:
    """Distances expected between markers (m), over people of all sizes in all poses."""

    mean_m: Array
    """(m, m) mean distances [m]."""
    sigma_m: Array
    """(m, m) standard deviations over people and poses [m]."""
    moved_m: Array
    """(m, m) standard deviations over the poses of one person [m]."""
    same: Array
    """(m, m) whether two markers are on one segment."""


def expectation(template: MarkerTemplate, seed: int = SEED) -> Expectation:
    """Return the expectation of the template's markers, from PERSONS drawn in POSES each."""
    rng = np.random.default_rng(seed)
    xyz = drawn_poses(template, template.variation, PERSONS, POSES, rng)
    distances = np.linalg.norm(xyz[..., :, None, :] - xyz[..., None, :, :], axis=-1)
    mean, sigma = distances.mean(axis=(0, 1)), distances.std(axis=(0, 1))
    moved = np.sqrt(distances.var(axis=1).mean(axis=0))
    return Expectation(mean, sigma, moved, template.segment[:, None] == template.segment)


def drawn_poses(
    template: MarkerTemplate, variation: BodyVariation, persons: int, poses: int, rng: np.random.Generator
) -> Array:
    """Return markers (persons, poses, m, 3) of drawn people in drawn poses, the first segment unturned."""
    n, g = persons, len(template.parent)
    size = np.exp(rng.normal(0, variation.stature, n))[:, None] * np.exp(rng.normal(0, variation.segment, (n, g)))
    local = (
        template.place_m
        - template.joint_m[template.segment]
        + rng.normal(0, 1, (n, *template.place_m.shape)) * template.spread_m
    )
    local = local * size[:, template.segment, None]
    # most poses are nearer to standing than to the end of a range
    low, high = template.turn_rad[..., 0], template.turn_rad[..., 1]
    turn = rng.triangular(low - 1e-9, 0.0, high + 1e-9, (n, poses, g, 3)) * rng.uniform(0, 1, (n, poses, 1, 1))
    world: list[Rotation] = []
    origin = np.zeros((n, poses, g, 3))
    out = np.empty((n, poses, len(template.names), 3))
    for k, parent in enumerate(template.parent.tolist()):
        # extrinsic: about z first, then x, then y
        own = Rotation.from_euler("zxy", turn[:, :, k, [2, 0, 1]].reshape(-1, 3))
        if parent < 0:
            world.append(own)
            origin[:, :, k] = template.joint_m[k]
        else:
            bone = (template.joint_m[k] - template.joint_m[parent]) * size[:, parent, None]
            world.append(world[parent] * own)
            step = world[parent].apply(np.repeat(bone, poses, axis=0)).reshape(n, poses, 3)
            origin[:, :, k] = origin[:, :, parent] + step
        for i in np.flatnonzero(template.segment == k):
            away = world[k].apply(np.repeat(local[:, i], poses, axis=0)).reshape(n, poses, 3)
            out[:, :, i] = origin[:, :, k] + away
    return out
