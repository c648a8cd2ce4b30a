"""The import rules hold, and their test detects violations."""

import ast
from pathlib import Path

import import_graph as graph
import import_law as law
import pytest
import reader_law

ROOT = Path(__file__).resolve().parent.parent


def trees():
    """Yield the path and the syntax tree of every product file."""
    for room in law.ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            yield str(path.relative_to(ROOT)), ast.parse(path.read_text(encoding="utf-8"))


def test_every_import_keeps_the_law():
    assert law.violations(ROOT) == []


@pytest.mark.parametrize(
    ("room", "line"),
    [
        ("mosca/detection/detect.py", "from mosca.data.truth import Truth"),
        ("mosca/detection/detect.py", "from mosca.data import truth"),
        ("mosca/detection/detect.py", "import mujoco"),
        ("mosca/detection/detect.py", "import control"),
        ("mosca/machines/identification/arx.py", "import matplotlib"),
        ("mosca/formats/bodies/subject_file.py", "import mujoco"),
        ("mosca/skeleton/model.py", "import trimesh"),
        ("mosca/skeleton/model.py", "from mosca.data.truth import Truth"),
        ("mosca/detection/detect.py", "from twin.source import TwinSource"),
        ("mosca/data/rig.py", "from mosca.camera.projection import project"),
        ("mosca/data/rig.py", "import numba"),
        ("twin/source.py", "from mosca.camera.projection import project"),
        ("twin/source.py", "from hardware.drivers import basler"),
        ("twin/source.py", "from mosca.camera.lens_models.mosca import pixels"),
        ("hardware/source.py", "import twin.source"),
        ("hardware/source.py", "from mosca.data.truth import Truth"),
        ("hardware/streams/play.py", "from mosca.rigid_bodies.tracker import BodyTracker"),
        ("hardware/streams/play.py", "from hardware.driver import DeviceError"),
        ("reports/page.py", "import rerun as rr"),
        ("reports/page.py", "from mosca.camera.projection import project"),
        ("witness/render.py", "from mosca.data.rig import Lens"),
        ("witness/render.py", "from twin.cameras.optics.lens import TwinLens"),
        ("witness/rays.py", "import trimesh"),
        ("witness/image.py", "import numba"),
        ("mosca/detection/detect.py", "from witness.image import contour_image"),
        ("twin/source.py", "from witness.image import contour_image"),
        ("mosca/tracking/tracker.py", "from .match import Predicted"),
        ("twin/source.py", "import importlib"),
        ("mosca/tracking/tracker.py", "def f():\n    import scenarios.run.scenario"),
    ],
)
def test_the_law_bites(tmp_path, room, line):
    path = tmp_path / room
    path.parent.mkdir(parents=True)
    path.write_text("import numpy\n")
    assert law.violations(tmp_path) == []
    path.write_text(f"import numpy\n{line}\n")
    assert len(law.violations(tmp_path)) == 1


def test_files_are_opened_by_bounded_readers():
    found = list(reader_law.entries(ROOT))
    assert reader_law.violations(found) == []
    assert reader_law.unused(found) == []


@pytest.mark.parametrize(
    "line",
    [
        "file = open(path)",
        "file = open(path, 'rb')",
        "file = open(path, mode='r+')",
        "file = open(path, mode)",
        "file = path.open()",
        "file = path.open('rb')",
        "text = Path(path).read_text(encoding='utf-8')",
        "data = path.read_bytes()",
        "import numpy as np\nnp.load(path)",
        "import tomllib\ntomllib.loads(text)",
        "from json import loads as parsed\nparsed(text)",
        "def f():\n    import json\n    json.load(file)",
        "import av\nav.open(path)",
        "import cv2\ncv2.imread(path)",
        "import cv2\ncv2.imdecode(data, 0)",
        "import cv2\ncv2.FileStorage(text, 0)",
        "import xml.etree.ElementTree as Xml\nXml.parse(path)",
        "from xml.etree import ElementTree\nElementTree.fromstring(text)",
        "import mujoco\nmujoco.MjSpec.from_file(path)",
    ],
)
def test_the_law_of_readers_bites(tmp_path, line):
    path = tmp_path / "mosca" / "recording" / "reader.py"
    path.parent.mkdir(parents=True)
    allowed = (
        "from mosca.data.files.bounded import read_text\n"
        "read_text(path)\nopen(path, 'wb')\npath.open('x')\nshutter.open(3, 5)\n"
    )
    path.write_text(allowed)
    assert reader_law.violations(reader_law.entries(tmp_path)) == []
    path.write_text(f"{allowed}{line}\n")
    assert len(reader_law.violations(reader_law.entries(tmp_path))) == 1


def test_files_can_be_read_in_one_sitting():
    long = {
        str(path.relative_to(ROOT)): lines
        for room in law.ROOMS
        for path in (ROOT / room).rglob("*.py")
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > 500
    }
    assert long == {}, "a file that outgrows one sitting tells two stories: split it"


@pytest.mark.parametrize(
    "package",
    [
        "mosca",
        "mosca.calibration",
        "mosca.continuous",
        "mosca.data",
        "mosca.formats",
        "twin",
        "twin.cameras",
        "hardware",
        "scenarios",
        "reports",
    ],
)
def test_folders_of_a_package_have_an_order(package):
    assert graph.cycle(graph.arrows(ROOT, package)) == []


def test_a_cycle_is_found(tmp_path):
    for name, text in {
        "a": "from pack.b import x\n",
        "b": "from pack import c\n",
        "c": "from pack.a.deep import y\n",
        "d": "def f():\n    import pack.d.deep, pack.a.deep\n",
    }.items():
        folder = tmp_path / "pack" / name
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text(text)
        (folder / "deep.py").write_text("")
    assert graph.cycle(graph.arrows(tmp_path, "pack")) == ["a", "b", "c", "a"]
    assert graph.arrows(tmp_path, "pack", inside_functions=True)["d"] == {"a"}
    (tmp_path / "pack" / "c" / "__init__.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from pack.a.deep import y\n"
    )
    assert graph.cycle(graph.arrows(tmp_path, "pack")) == []


@pytest.mark.parametrize(("package", "most"), [("mosca", 28), ("scenarios", 18), ("twin/cameras", 12)])
def test_a_package_can_be_taken_in_at_a_glance(package, most):
    entries = [p.name for p in (ROOT / package).iterdir() if p.name not in ("__init__.py", "__pycache__")]
    assert len(entries) <= most


def test_no_two_public_classes_have_one_name():
    """One name, one thing: a reader who searches for a class finds one."""
    named: dict[str, list[str]] = {}
    for path, tree in trees():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                named.setdefault(node.name, []).append(path)
    assert {name: places for name, places in named.items() if len(places) > 1} == {}


def test_functions_fit_a_page_and_take_few_arguments_by_position():
    """At most 80 lines and 10 positional parameters; more belong together in a structured value."""
    too_much = []
    for path, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                positional = len(node.args.posonlyargs) + len(node.args.args)
                if lines > 80 or positional > 10:
                    too_much.append(f"{path}: {node.name}: {lines} lines, {positional} parameters")
    assert too_much == []
