"""Finds the places that open or parse a file, and compares them with a short list. Used by test_architecture.

All others go through ``mosca.data.files``: ``bounded`` (regular files of a size that can be held), ``toml`` and
``npz``, so that no file that a user gives can block, crash or fill the memory.
"""

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

from import_law import ROOMS

ENTRIES = {
    "open", "io.open", "json.load", "json.loads", "tomllib.load", "tomllib.loads", "pickle.load", "pickle.loads",
    "numpy.load", "numpy.loadtxt", "numpy.genfromtxt", "numpy.fromfile", "numpy.memmap", "zipfile.ZipFile",
    "av.open", "cv2.imread", "cv2.imreadmulti", "cv2.imdecode", "cv2.imdecodemulti", "cv2.FileStorage",
    "xml.etree.ElementTree.parse", "xml.etree.ElementTree.iterparse", "xml.etree.ElementTree.fromstring",
    "xml.etree.ElementTree.XML", "ezc3d.c3d", "blosc2.decompress2", "mcap.reader.make_reader",
    "mcap.stream_reader.StreamReader", "pyarrow.parquet.ParquetFile", "pyarrow.parquet.read_table",
    "mujoco.MjSpec.from_file", "mujoco.MjSpec.from_string", "mujoco.MjModel.from_xml_path",
    "mujoco.MjModel.from_xml_string", "trimesh.load", "trimesh.load_mesh",
}  # fmt: skip
METHODS = ("read_text", "read_bytes")
"""Of paths, called on anything."""

OWN = "a file of this program's own"
ALLOWED = {
    ("mosca/data/files/bounded.py", "json.loads"): "the one parser of JSON, behind a limit of its depth",
    ("mosca/data/files/toml.py", "tomllib.loads"): "the one parser of TOML, behind limits of depth and size",
    ("mosca/data/files/npz.py", "numpy.load"): "behind a check of all sizes that the archive states",
    ("mosca/data/files/npz.py", "zipfile.ZipFile"): "that check; of a file that is open",
    ("mosca/recording/images.py", "cv2.imdecode"): "behind a check of the size that the header states",
    ("mosca/recording/video.py", "av.open"): "behind open_file, with a limit of pixels and of what it may open",
    ("mosca/recording/mcap_source.py", "mcap.reader.make_reader"): "of a file from open_file",
    ("mosca/recording/mcap_source.py", "mcap.stream_reader.StreamReader"): "the same, with a limit of a record",
    ("mosca/recording/mcap_format.py", "blosc2.decompress2"): "behind a check of the size that the chunk states",
    ("mosca/formats/rigs/opencv_yaml.py", "cv2.FileStorage"): "of a text with a limit of what may be nested",
    ("mosca/formats/rigs/qtm.py", "xml.etree.ElementTree.fromstring"): "of a short text, without document types",
    ("mosca/formats/tracks/c3d.py", "ezc3d.c3d"): "behind c3d_checks",
    ("mosca/formats/tracks/parquet.py", "pyarrow.parquet.ParquetFile"): "of a file from open_file; sizes are checked",
    ("mosca/numba_support/cache.py", "read_bytes"): OWN,
    ("scenarios/run/kept_calibrations.py", "pickle.loads"): "of a file that it wrote itself, behind its digest",
    ("scenarios/spec/new_scenario.py", "read_text"): OWN,
    ("scenarios/fidelity/peers.py", "numpy.load"): OWN,
    ("scenarios/suite/on_cluster.py", "open"): "archives in memory, packed by the same code on a worker",
    ("scenarios/run/one_writer.py", "open"): "the lock, which must be open for writing; its first bytes are read",
    ("hardware/drivers/webcam.py", "read_text"): "the operating system's names of cameras",
    ("scenarios/run/priority.py", "read_text"): "the operating system's list of processes",
    ("hardware/drivers/control_switchover.py", "open"): "the lock of a camera's key, which must be open for writing",
    ("scenarios/studies/benchmark/entrants/contract.py", "open"): "an adapter imports nothing of the project",
    ("scenarios/studies/benchmark/entrants/contract.py", "read_text"): "the same",
    ("scenarios/studies/benchmark/entrants/contract.py", "json.loads"): "the same",
    ("scenarios/studies/benchmark/entrants/opencv_dlt.py", "cv2.imread"): "the same",
    ("scenarios/studies/benchmark/entrants/trackpy_dlt.py", "cv2.imread"): "the same",
    ("scenarios/studies/benchmark/execute.py", "read_text"): "the operating system's account of a process",
    ("witness/mitsuba/film.py", "numpy.load"): "renders that it kept itself",
    ("witness/mitsuba/scene.py", "read_text"): "its own sources, whose digest names a render",
    ("witness/mitsuba/scene_file.py", "open"): "scenes of the witness; it imports nothing of the project",
    ("witness/mitsuba/scene_file.py", "tomllib.load"): "the same",
    ("witness/mitsuba/scene_file.py", "read_bytes"): "the mesh that such a scene names",
    ("witness/mitsuba/tracks.py", "open"): "rigs and paths that such a scene names",
    ("witness/mitsuba/tracks.py", "tomllib.load"): "the same",
    ("witness/mitsuba/surfaces.py", "numpy.load"): "the same",
    (
        "mosca/skeleton/mjcf.py",
        "xml.etree.ElementTree.fromstring",
    ): "the one parser of MJCF, behind limits of size and depth",
    ("mosca/skeleton/mjcf.py", "mujoco.MjModel.from_xml_string"): "behind that parser: no element that reads a file",
    ("mosca/skeleton/model.py", "mujoco.MjModel.from_xml_string"): "of a text that mjcf.py has compiled before",
    ("twin/scenes/user_model.py", "mujoco.MjSpec.from_file"): "MuJoCo itself opens the meshes that a model names",
    ("twin/scenes/user_model.py", "mujoco.MjSpec.from_string"): "of a text from read_text",
}
"""Where an entry may stand, and why."""


def violations(found: Iterable[tuple[str, int, str]]) -> list[str]:
    """Return one line for each entry that is not allowed where it was ``found``."""
    return [
        f"{path}:{line}: {entry}; mosca.data.files.bounded opens files and parses JSON"
        for path, line, entry in found
        if (path, entry) not in ALLOWED
    ]


def unused(found: Iterable[tuple[str, int, str]]) -> list[tuple[str, str]]:
    """Return the rows of ``ALLOWED`` that allow nothing."""
    there = {(path, entry) for path, _, entry in found}
    return [row for row in ALLOWED if row not in there]


def entries(root: Path) -> Iterator[tuple[str, int, str]]:
    """Yield (path, line, entry) of every entry below ``root``."""
    for room in ROOMS:
        for path in sorted((root / room).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            names = dict(_names(tree))
            for node in ast.walk(tree):
                if isinstance(node, ast.Call) and (entry := _entry(node, names)):
                    yield str(path.relative_to(root)), node.lineno, entry


def _names(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield what a file calls a module or a function, and its full name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield (alias.asname, alias.name) if alias.asname else (alias.name.split(".")[0],) * 2
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                yield alias.asname or alias.name, f"{node.module}.{alias.name}"


def _entry(call: ast.Call, names: dict[str, str]) -> str:
    """Return the entry that a call is, "" for none."""
    name = _dotted(call.func, names)
    if name in ("open", "io.open"):
        return name if _reads(call, 1) else ""
    if name in ENTRIES:
        return name
    if isinstance(call.func, ast.Attribute):
        if call.func.attr in METHODS:
            return call.func.attr
        if call.func.attr == "open" and name not in ENTRIES and _is_path_open(call):
            return "open"
    return ""


def _dotted(node: ast.AST, names: dict[str, str]) -> str:
    if isinstance(node, ast.Name):
        return names.get(node.id, node.id)
    return f"{_dotted(node.value, names)}.{node.attr}" if isinstance(node, ast.Attribute) else ""


def _mode(call: ast.Call, position: int) -> object:
    """Return the mode of a call of ``open``; None where it is not a plain text."""
    given = [one.value for one in call.keywords if one.arg == "mode"] or call.args[position : position + 1]
    if not given:
        return "r"
    return given[0].value if isinstance(given[0], ast.Constant) else None


def _reads(call: ast.Call, position: int) -> bool:
    mode = _mode(call, position)
    return not isinstance(mode, str) or "r" in mode or "+" in mode


def _is_path_open(call: ast.Call) -> bool:
    """Return whether ``x.open(...)`` looks like a path's: other objects are opened with other arguments."""
    mode = _mode(call, 0)
    return isinstance(mode, str) and mode.strip("rwxabt+") == "" and _reads(call, 0)
