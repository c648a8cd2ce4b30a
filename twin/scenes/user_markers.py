"""Markers on a user's own model, from a table or the model's own sites and geoms, placed on surfaces by trimesh."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import mujoco
import numpy as np
from pydantic import BeforeValidator, Field

from mosca.data.arrays import Array
from mosca.data.files.bounded import read_text
from mosca.data.files.decimals import BLANKS, real
from mosca.data.files.toml import Table, check, read_toml
from mosca.errors import InputError
from twin.scenes.scene import MARKER_GROUP, UNSEEN_GROUP
from twin.scenes.world import add_ball_marker, add_flat_target, add_marker

if TYPE_CHECKING:
    from trimesh import Trimesh

_TIE_M = 1e-6
_SPHERE_SUBDIVISIONS = 5  # faces 0.02 of the radius long: the resolution of a marker's position on round shapes

Cell = Annotated[float, BeforeValidator(lambda given: real(given) if isinstance(given, str) else given)]


class OwnMarker(Table):
    """A row of the marker table; x, y, z [m] in the body's axes need only be near the surface."""

    name: str = Field(min_length=1)
    body: str = Field(min_length=1)
    x: Cell
    y: Cell
    z: Cell
    diameter: Cell = Field(default=0.016, gt=0, lt=1)
    kind: Literal["ball", "flat"] = "ball"


@dataclass(frozen=True)
class MarkersInModel:
    """Choice of the model's own sites, or spheres, with names like ``pattern`` (shell wildcards) as its markers.

    A site marks a place near the surface on which a ball of the site's size is seated; a sphere is the ball itself.
    """

    kind: Literal["sites", "geoms"]
    pattern: str

    @classmethod
    def of_words(cls, words: str) -> Self | None:
        """Return the choice in "sites", "sites:PATTERN" or "geoms:PATTERN"; None for others (the path of a table)."""
        found = re.fullmatch(r"(sites|geoms)(?::(.+))?", words)
        return None if found is None else cls(found[1], found[2] or "*")  # type: ignore[arg-type]

    def __str__(self) -> str:
        return f"{self.kind}:{self.pattern}"

    def found(self, model: mujoco.MjModel, source: Path) -> tuple["OwnMarker", ...]:
        """Return the markers of ``model``; InputError where there are none, or where the body of one has no name."""
        if self.kind == "sites":
            there = [model.site(k) for k in range(model.nsite)]
        else:
            sphere = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
            there = [model.geom(int(k)) for k in np.flatnonzero(sphere)]
        named = {one.name: one for one in there if one.name}
        wanted = [one for name, one in named.items() if fnmatchcase(name, self.pattern)]
        what = "sites" if self.kind == "sites" else "spheres"
        if not wanted:
            names = ", ".join(list(named)[:10]) + (", ..." if len(named) > 10 else "")
            raise InputError(
                f"{source}: markers '{self}' given; named {what} in the model: {names or 'none'}; give a pattern "
                "that matches some, or a table of markers"
            )
        markers = []
        for one in wanted:
            body = model.body(int(one.bodyid[0])).name
            if not body:
                raise InputError(f"{source}: marker '{one.name}' is on a body without a name; name the body")
            row = {"name": one.name, "body": body, **dict(zip("xyz", map(float, one.pos), strict=True))}
            markers.append(check(OwnMarker, {**row, "diameter": 2 * float(one.size[0])}, f"{source}: '{one.name}'"))
        return tuple(markers)

    def place(self, spec: mujoco.MjSpec, surfaces: "Surfaces", markers: Sequence["OwnMarker"], source: Path) -> None:
        """Add ``markers`` to the bodies of ``spec``; a sphere that is a marker is visible as the marker only."""
        if self.kind == "sites":
            seat_markers(spec, surfaces, markers, source)
            return
        for marker in markers:
            spec.geom(marker.name).group = UNSEEN_GROUP
            center = np.array([marker.x, marker.y, marker.z])
            size = [marker.diameter / 2, 0, 0]
            add_marker(spec.body(marker.body), marker.name, mujoco.mjtGeom.mjGEOM_SPHERE, size, center, np.eye(3))


class _MarkerFile(Table):
    marker: tuple[OwnMarker, ...]


def read_marker_table(path: Path) -> tuple[OwnMarker, ...]:
    """Return the markers in ``path``: a CSV with a header, or a TOML with one [[marker]] each.

    Columns or keys: name, body, x, y, z, and optionally diameter (0.016 m) and kind (ball | flat).
    Raises InputError naming file, row and value.
    """
    if path.suffix.lower() == ".toml":
        markers = check(_MarkerFile, read_toml(path), path).marker
    else:
        markers = tuple(check(OwnMarker, row, f"{path}: row {k}") for k, row in enumerate(_rows(path), 2))
    names = [marker.name for marker in markers]
    doubles = sorted({name for name in names if names.count(name) > 1})
    if not markers or doubles:
        what = f"marker name '{doubles[0]}' is used twice; names must differ" if doubles else "no markers; add some"
        raise InputError(f"{path}: {what}")
    return markers


def _rows(path: Path) -> list[dict[str, Any]]:
    lines = read_text(path, "a marker table (CSV or TOML)", "utf-8-sig").splitlines()
    try:
        rows = list(csv.DictReader(lines, strict=True, skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as a CSV table: {error}") from None
    for k, row in enumerate(rows, 2):
        if None in row or None in row.values():
            raise InputError(f"{path}: row {k} has not as many cells as the header; fill it up")
    # An empty cell means the default.
    return [{key: cell.strip(BLANKS) for key, cell in row.items() if cell.strip(BLANKS)} for row in rows]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Visible surfaces of a compiled model's bodies: triangle meshes in each body's axes."""

    meshes: dict[str, "Trimesh"]

    def nearest(self, body: str, point: Array) -> tuple[Array, Array]:
        """Return the surface point (3,) of ``body`` nearest to ``point`` (3,) and its outward normal (3,).

        On an edge or a corner the normal is the mean of the faces that meet there.
        """
        from trimesh.triangles import closest_point  # takes a third of a second to import

        mesh = self.meshes[body]
        near = closest_point(mesh.triangles, np.broadcast_to(point, (len(mesh.faces), 3)))
        distance = np.linalg.norm(near - point, axis=1)
        best = int(np.argmin(distance))
        meeting = np.linalg.norm(near - near[best], axis=1) < _TIE_M
        normal = mesh.face_normals[meeting].mean(axis=0)
        if np.linalg.norm(normal) < 1e-3:  # both faces of a sheet
            normal = mesh.face_normals[best]
        return near[best], normal / np.linalg.norm(normal)


def surfaces_of(model: mujoco.MjModel) -> Surfaces:
    """Return the visible surfaces of all bodies of ``model`` (planes, height fields and markers left out)."""
    import trimesh  # takes a third of a second to import

    meshes: dict[str, Trimesh] = {}
    for body in range(model.nbody):
        parts = [
            part
            for g in np.nonzero(model.geom_bodyid == body)[0]
            if model.geom_group[g] not in (MARKER_GROUP, UNSEEN_GROUP)
            and (part := _geom_mesh(model, int(g))) is not None
        ]
        if parts:
            corners = np.concatenate([part.triangles for part in parts]).reshape(-1, 3)
            faces = np.arange(len(corners)).reshape(-1, 3)
            meshes[model.body(body).name] = trimesh.Trimesh(corners, faces, process=False)
    return Surfaces(meshes)


def seat_markers(spec: mujoco.MjSpec, surfaces: Surfaces, markers: Sequence[OwnMarker], source: Path) -> None:
    """Add ``markers`` to the bodies of ``spec``, each on the surface nearest to the point in its row."""
    for marker in markers:
        if marker.body not in surfaces.meshes:
            known = ", ".join(sorted(surfaces.meshes)) or "none"
            raise InputError(
                f"{source}: marker '{marker.name}': body '{marker.body}' given; bodies with a surface: {known}"
            )
        surface, normal = surfaces.nearest(marker.body, np.array([marker.x, marker.y, marker.z]))
        add = add_flat_target if marker.kind == "flat" else add_ball_marker
        add(spec.body(marker.body), marker.name, surface, normal, marker.diameter)


def _geom_mesh(model: mujoco.MjModel, geom: int) -> "Trimesh | None":
    """Return the geom as a triangle mesh in its body's axes; None for geoms without a closed surface here."""
    import trimesh  # takes a third of a second to import

    kinds = mujoco.mjtGeom
    kind, size = kinds(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == kinds.mjGEOM_MESH:
        data = int(model.geom_dataid[geom])
        v, f = int(model.mesh_vertadr[data]), int(model.mesh_faceadr[data])
        mesh = trimesh.Trimesh(
            model.mesh_vert[v : v + model.mesh_vertnum[data]].astype(np.float64),
            model.mesh_face[f : f + model.mesh_facenum[data]],
        )
        if mesh.is_watertight and mesh.volume < 0:
            mesh.invert()
    elif kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
        mesh = trimesh.creation.icosphere(subdivisions=_SPHERE_SUBDIVISIONS, radius=1.0)
        mesh.apply_scale(size if kind == kinds.mjGEOM_ELLIPSOID else np.full(3, size[0]))
    elif kind == kinds.mjGEOM_BOX:
        mesh = trimesh.creation.box(extents=2 * size)
    elif kind == kinds.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=256)
    elif kind == kinds.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[128, 128])
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    else:
        return None
    pose, rotation = np.eye(4), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
    return mesh.apply_transform(pose)
