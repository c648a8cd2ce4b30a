"""Readers of TOML files and what ``tomllib`` says is in them."""

import csv
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from fuzz.reader import Reader
from rigs import ring
from scipy.spatial.transform import Rotation

from hardware.onboard.commands import read_program
from hardware.settings import read_hardware
from hardware.streams.faults import read_faults
from mosca.data.bodies import RigidBody
from mosca.data.files.rig_file import read_rig, write_rig
from mosca.data.files.target_file import read_measured_points, read_target_file
from mosca.data.rig import FisheyeLens, MoscaLens, OpenCVLens, Rig
from mosca.editing.edit_file import Edits, read_motion_edits, read_track_edits
from mosca.formats.bodies.body_file import read_bodies, write_bodies
from mosca.formats.bodies.model_file import read_model
from mosca.labelling.automatic.template import STANDARD, read_template
from mosca.labelling.surface.model import FACE, read_surface_model
from scenarios.commands.lamp_file import read_lamps
from scenarios.lab_twin.lab_file import read_lab
from scenarios.spec.claim import load_claim
from scenarios.spec.plan import load_plan
from scenarios.spec.scenario import load_scenario
from scenarios.studies.campaign.campaign import CLAIMS
from twin.scenes.user_markers import read_marker_table

ROOT = Path(__file__).resolve().parents[2]
LENSES = (
    OpenCVLens(900.5, 901.25, 320.0, 250.0, k1=-0.1, k2=0.02, p1=1e-3, tauX=0.01),
    MoscaLens(8.0, 330.0, 240.0, 0.01, 0.0101, a=1e-4),
    FisheyeLens(300.0, 300.5, 327.5, 245.0, 0.01, -0.002, 0.0, 1e-4),
)


def values_of(rig: Rig) -> list[dict[str, Any]]:
    """Return the cameras of a rig as plain values."""
    return [
        {
            "name": one.name,
            "size": [one.width, one.height],
            "lens": {"model": one.lens.model, **asdict(one.lens)},
            "rotation": np.array(one.world_from_camera.rotation),
            "position": np.array(one.world_from_camera.translation),
        }
        for one in rig.cameras
    ]


def document(path: Path) -> dict[str, Any]:
    """Return what a TOML file holds."""
    return tomllib.loads(path.read_bytes().decode("utf-8"))


def toml_seed(text: str, name: str = "a.toml") -> Callable[[Path], None]:
    """Return a seed of one text file."""
    return lambda folder: (folder / name).write_text(text, encoding="utf-8") and None


def as_given(values: Any, given: Any) -> tuple[Any, Any]:
    """Return the part of ``values`` that stands in a document, and the document.

    A number in quotes counts as that number.
    """
    if isinstance(given, Mapping) and isinstance(values, Mapping):
        pairs = {key: as_given(values.get(key, "nothing"), one) for key, one in given.items()}
        return {key: a for key, (a, _) in pairs.items()}, {key: b for key, (_, b) in pairs.items()}
    if isinstance(given, list) and isinstance(values, list | tuple) and len(given) == len(values):
        both = [as_given(a, b) for a, b in zip(values, given, strict=True)]
        return [a for a, _ in both], [b for _, b in both]
    if isinstance(given, str) and isinstance(values, int | float):
        return values, float(given)
    if isinstance(values, bool) and isinstance(given, int):
        return values, bool(given)
    if isinstance(values, Path):
        return str(values), given
    return values, given


def _rig_seed(folder: Path) -> None:
    write_rig(ring(3, LENSES), folder / "a.toml")


def _rig_expected(folder: Path) -> list[dict[str, Any]]:
    cameras = []
    for table in document(folder / "a.toml")["camera"]:
        lens = next(one for one in LENSES if one.model == table["lens"]["model"])
        w, x, y, z = (float(value) for value in table["pose"]["rotation_wxyz"])
        zeros = dict.fromkeys(asdict(lens), 0.0)
        cameras.append(
            {
                "name": table["name"],
                "size": table["size"],
                "lens": {**zeros, **table["lens"]},
                "rotation": Rotation.from_quat([x, y, z, w]).as_matrix(),
                "position": table["pose"]["position_m"],
            }
        )
    return cameras


HARDWARE = """
[hardware]
rate_hz = 50.0
[hardware.trigger]
source = "serial"
port = "/dev/ttyACM0"
baud = 9600
[[camera]]
name = "left"
size = [656, 491]
[camera.hardware]
driver = "gige"
serial = "123"
exposure_us = 800.0
gain_db = 3
window = [0, 128, 656, 256]
features = { Gamma = 1.5, AcquisitionFrameRateEnable = false }
[[camera]]
name = "right"
size = [656, 491]
[camera.hardware]
driver = "webcam"
address = "0"
trigger = "Off"
"""


def _hardware(folder: Path) -> dict[str, Any]:
    path = folder / "a.toml"
    read = read_hardware(path)
    cameras = [{"name": n, "size": read.sizes[n], "hardware": c.model_dump()} for n, c in read.cameras.items()]
    values = {"camera": cameras, "hardware": read.shared.model_dump()}
    try:
        there = document(path)
    except ValueError:
        return values
    for table in there.get("camera", ()):  # not read by hardware
        for key in set(table) - {"name", "size", "hardware"}:
            del table[key]
    return as_given(values, {key: there[key] for key in ("camera", "hardware") if key in there})


LAB = """
recordings = ["dark:lab/dark"]
[[camera]]
name = "cam1"
errors = { read_noise_e = 7.5, bits = 12 }
mount = { vibration_hz = [8.0, 20.0], vibration_px = 0.05 }
[[estimate]]
camera = "cam1"
key = "errors.read_noise_e"
value = 7.5
sigma = 0.25
low = 7.0
high = 8.0
evidence = "16 dark images"
[[not_told]]
camera = "cam1"
key = "errors.psf_sigma_px"
reason = "needs targets at rest"
"""

TARGETS = {
    "field": 'kind = "field"\ndot_radius_m = 0.008\nsigma_m = 2e-5\n[[target]]\nnumber = 17\n'
    "position_m = [0.1, 0.0, 0.35]\nnormal = [0.0, 1.0, 0.0]\n[[target]]\nnumber = 18\nposition_m = [0.3, 0.2, 0.1]\n"
    "[[target]]\nname = 'disc'\nposition_m = [0.5, 0.5, 0]\n[[target]]\nnumber = 3\nposition_m = [0.9, 0.2, 0.1]\n",
    "board": 'kind = "board"\ncolumns = 9\nrows = 6\nsquare_m = 0.04\nmargin_m = 0.02\nmarker_m = 0.03\n'
    'dictionary = "DICT_5X5_50"\nsigma_m = 1e-5\n',
    "wand": 'kind = "wand"\nalong_m = [0.0, 0.15, 0.5]\ndiameter_m = 0.014\nsigma_m = 3e-5\n',
    "l_frame": 'kind = "l_frame"\ndiameter_m = 0.014\nsigma_m = 1e-4\n'
    + "".join(
        f'[[marker]]\nname = "{name}"\nposition_m = {place}\n'
        for name, place in (("origin", [0.0, 0.0, 0.0]), ("long", [0.6, 0.0, 0.0]), ("short", [0.0, 0.4, 0.0]))
    ),
    "scale_bar": 'kind = "scale_bar"\nlength_m = 1.00012\nsigma_m = 5e-6\nnumbers = [3, 4]\ndot_radius_m = 0.008\n',
}


def _target(folder: Path) -> Any:
    made = read_target_file(folder / "a.toml")
    match type(made).__name__:
        case "TestField":
            return {
                "sigma_m": made.sigma_m,
                "positions": made.positions,
                "normals": [placed.rotation[:, 2] for placed in made.targets],
                "numbers": [getattr(placed.target, "number", None) for placed in made.targets],
                "radius": [getattr(p.target, "dot_radius_m", getattr(p.target, "radius_m", 0)) for p in made.targets],
            }
        case "LFrame":
            return {"marker": list(zip(made.names, made.positions.tolist(), strict=True)), **_sizes(made)}
        case "ScaleBar":
            return {
                "length_m": made.length_m,
                "sigma_m": made.sigma_m,
                "ends": [getattr(end, "number", None) for end in made.ends],
            }
        case "PointsTarget":
            return made.model_dump()
    return asdict(made)


def _sizes(made: Any) -> dict[str, float]:
    return {"diameter_m": made.diameter_m, "sigma_m": made.sigma_m}


def _target_expected(folder: Path) -> Any:
    given = document(folder / "a.toml")
    sigma = given.get("sigma_m", 0.0)
    match given["kind"]:
        case "field":
            normals = [np.array(t.get("normal", (0.0, 0.0, 1.0)), float) for t in given["target"]]
            round_m = given.get("plain_radius_m", given["dot_radius_m"])
            return {
                "sigma_m": sigma,
                "positions": np.array([t["position_m"] for t in given["target"]], float),
                "normals": [n / np.linalg.norm(n) for n in normals],
                "numbers": [t.get("number") for t in given["target"]],
                "radius": [given["dot_radius_m"] if "number" in t else round_m for t in given["target"]],
            }
        case "l_frame":
            markers = [(one["name"], one["position_m"]) for one in given["marker"]]
            return {"marker": markers, "diameter_m": given["diameter_m"], "sigma_m": sigma}
        case "scale_bar":
            ends = given.get("numbers", [None, None])
            return {"length_m": given["length_m"], "sigma_m": given["sigma_m"], "ends": ends}
        case "board":
            keys = ("columns", "rows", "square_m", "margin_m", "marker_m", "dictionary")
            board = {key: given.get(key) for key in keys}
            return {**board, "margin_m": given.get("margin_m", given["square_m"]), "sigma_m": sigma}
        case "wand":
            return {"along_m": given["along_m"], "diameter_m": given["diameter_m"], "sigma_m": sigma}
    raise ValueError(given["kind"])


POINTS = """kind = "points"
unit = "mm"
columns = ["u", "v", "X", "Y", "Z"]
pixel_origin = "corner"
size_px = [1280, 1024]
[[camera]]
name = "left"
file = "left.txt"
"""


def _points_seed(folder: Path) -> None:
    (folder / "a.toml").write_text(POINTS)
    rows = np.random.default_rng(1).normal(100.0, 50.0, (12, 5))
    lines = [" ".join(repr(float(value)) for value in row) for row in rows]
    (folder / "left.txt").write_text("# u v X Y Z\n" + "\n".join(lines) + "\n")


def _points(folder: Path) -> Any:
    target = read_target_file(folder / "a.toml")
    points = read_measured_points(folder / target.camera[0].file, target)
    return {"camera": [one.name for one in target.camera], "xy": points.xy_px, "xyz": points.xyz}


def _points_expected(folder: Path) -> Any:
    given = document(folder / "a.toml")
    text = (folder / given["camera"][0]["file"]).read_bytes().decode("utf-8")
    text = text.replace(",", " ").replace(";", " ")
    table = np.array([row for line in text.splitlines() if (row := line.split("#")[0].split())])
    columns = given.get("columns", ["u", "v", "X", "Y", "Z"])
    column = {name: plain(table[:, k]) for k, name in enumerate(columns) if name != "-"}
    shift = {"centre": 0.0, "corner": 0.5, "one": 1.0}[given.get("pixel_origin", "centre")]
    unit = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}[given["unit"]]
    return {
        "camera": [one["name"] for one in given["camera"]],
        "xy": np.stack([column["u"], column["v"]], axis=1) - shift,
        "xyz": np.stack([column[a] for a in "XYZ"], axis=1) * unit,
    }


def plain(cells: Any) -> np.ndarray:
    """Return decimal numbers as every program reads them: no underscores, no digits of other scripts."""
    given = [str(one).strip() for one in cells]
    for one in given:
        if "_" in one or not one.isascii():
            raise ValueError(f"{one!r} is a number for Python alone")
    return np.array([float(one) for one in given])


def _bodies_seed(folder: Path) -> None:
    rng = np.random.default_rng(3)
    write_bodies(
        [
            RigidBody(name, tuple(f"{name}/{k}" for k in range(5)), rng.uniform(-0.2, 0.2, (5, 3)), 2e-4)
            for name in ("drone", "box")
        ],
        folder / "a.toml",
    )


def _bodies(folder: Path) -> Any:
    return [(b.name, b.sigma_m, list(b.markers), b.positions) for b in read_bodies(folder / "a.toml")]


def _bodies_expected(folder: Path) -> Any:
    return [
        (
            body["name"],
            body.get("sigma_m", 0.0),
            [one.get("name", f"{body['name']}/{k}") for k, one in enumerate(body["marker"], 1)],
            np.array([one["position_m"] for one in body["marker"]], float),
        )
        for body in document(folder / "a.toml")["body"]
    ]


MODEL = """kind = "marker-model"
markers = ["LFHD", "RFHD", "LBHD", "C7"]
links = [
  ["LFHD", "RFHD", 0.1512, 0.0041],
  ["LFHD", "LBHD", 0.2, 0.003],
  ["C7", "LBHD", 0.25, 0.01],
]
sides = [
  ["LFHD", "RFHD", "LBHD", "C7", 0.0002],
]
[limbs]
head = ["LFHD", "RFHD", "LBHD"]
"""


def _model(folder: Path) -> Any:
    model = read_model(folder / "a.toml")
    n = len(model.names)
    links = {
        f"{model.names[i]}-{model.names[j]}": (model.mean_m[i, j], model.sigma_m[i, j])
        for i in range(n)
        for j in range(n)
        if i != j and np.isfinite(model.mean_m[i, j])
    }
    sides = [[*(model.names[k] for k in four), v] for four, v in zip(model.quads, model.volume_m3, strict=True)]
    return {"names": model.names, "links": links, "sides": sides, "limbs": dict(model.limbs)}


def _model_expected(folder: Path) -> Any:
    given = document(folder / "a.toml")
    links = {}
    for a, b, *numbers in given["links"]:
        links[f"{a}-{b}"] = links[f"{b}-{a}"] = tuple(map(float, numbers))
    return {
        "names": tuple(given["markers"]),
        "links": links,
        "sides": given.get("sides", []),
        "limbs": given.get("limbs", {}),
    }


FAULTS = """seed = 3
[[program]]
fault = "latency"
at_s = 1.5
for_s = 2.0
value = 0.03
[[program]]
fault = "label-swap"
names = ["LFHD", "RFHD"]
[[program]]
fault = "burst-loss"
value = 7
at_s = 4
"""
PROGRAM = """[[target]]
name = "robot"
kind = "tcp"
address = "192.168.7.30:7000"
reply_s = 1.5
[[event]]
name = "imu"
kind = "udp"
address = "127.0.0.1:7001"
sender = "192.168.7.30"
[[program]]
at_s = 1.0
target = "robot"
command = { left = 120, right = 80 }
[[program]]
at_s = 2.5
target = "robot"
command = "stop"
"""
LAMPS = "bit_s = 0.02\nknown = ['c0', 'c1']\n" + "".join(
    f"[[lamp]]\ncamera = 'c{k}'\nnumber = {k + 3}\nat_m = [0.0, 0.0{k}, -0.02]\n" for k in range(3)
)


def _lamps(folder: Path) -> Any:
    known, lamps = read_lamps(folder / "a.toml", ring(3))
    return {"known": known, "numbers": lamps.numbers, "at": lamps.at_m, "bit_s": lamps.bit_s}


def _lamps_expected(folder: Path) -> Any:
    given = document(folder / "a.toml")
    lamps = sorted(given["lamp"], key=lambda one: one["camera"])
    return {
        "known": given["known"],
        "numbers": [one["number"] for one in lamps],
        "at": np.array([one["at_m"] for one in lamps], float),
        "bit_s": given["bit_s"],
    }


TRACK_EDITS = """[[edit]]
trim = { frames = [2, 48] }
[[edit]]
swap = { labels = ["A", "B"], frames = [20, 30] }
[[edit]]
rename = { labels = { "#3" = "C" } }
[[edit]]
fill = { labels = ["A"], longest_s = 0.2, cluster = ["B", "C", "D"] }
[[edit]]
filter = { cutoff_hz = 12.0 }
[[edit]]
delete = { labels = ["D"], frames = [3, 4] }
[[edit]]
[edit.offset]
labels = ["A"]
blend = "linear"
keyframes = [{ frame = 10, xyz_m = [0, 0, 0.01] }, { frame = 20, xyz_m = [0.0, 0.5, -1e-3] }]
"""
MOTION_EDITS = """[[edit]]
rotate = { joint = "knee", keyframes = [{ frame = 10, rotation_vector_deg = [0, 0, 30] }] }
[[edit]]
foot_lock = { leg = ["hip", "knee", "ankle"], contacts = [[3, 9], [20, 30]], blend_s = 0.1 }
[[edit]]
retarget = { skeleton = "b.bvh", feet = ["ankle"], joints = { b = "hip" } }
"""


def _edits(read: Callable[[Path], Edits[Any]]) -> tuple[Callable[[Path], Any], Callable[[Path], Any]]:
    """Return reading and expectation of a file of edits, of the keys that it gives."""

    def both(folder: Path) -> tuple[Any, Any]:
        edits = read(folder / "a.toml")
        values = [{n: asdict(one)} for n, one in zip(edits.names, edits.operations, strict=True)]  # type: ignore[call-overload]
        given = document(folder / "a.toml")["edit"]
        for one in given:
            if "retarget" in one:
                one["retarget"]["skeleton"] = str(folder / one["retarget"]["skeleton"])
        return as_given(values, given)

    return (lambda folder: both(folder)[0]), (lambda folder: both(folder)[1])


MARKERS = (
    "name,body,x,y,z,diameter,kind\na,base,0.1,0.2,0.3,0.012,ball\nb,base,1e-2,-0.2,0,,flat\nc,arm,0,0,1.5,0.02,\n"
)


def _markers(folder: Path) -> Any:
    return [one.model_dump() for one in read_marker_table(folder / "a.csv")]


def _markers_expected(folder: Path) -> Any:
    text = (folder / "a.csv").read_bytes().decode("utf-8-sig")
    header, *rows = [[c.strip() for c in row] for row in csv.reader(text.splitlines(), skipinitialspace=True) if row]
    tables = [dict(zip(header, row, strict=True)) for row in rows]
    return [
        {
            "name": one["name"],
            "body": one["body"],
            **{axis: plain([one[axis]])[0] for axis in "xyz"},
            "diameter": plain([one.get("diameter") or "0.016"])[0],
            "kind": one.get("kind") or "ball",
        }
        for one in tables
    ]


def _models(read: Callable[[Path], Any]) -> tuple[Callable[[Path], Any], Callable[[Path], Any]]:
    """Return reading and expectation of a reader that gives a pydantic model of the whole document."""

    def ours(folder: Path) -> Any:
        return as_given(read(folder / "a.toml").model_dump(), document(folder / "a.toml"))[0]

    def theirs(folder: Path) -> Any:
        return as_given(read(folder / "a.toml").model_dump(), document(folder / "a.toml"))[1]

    return ours, theirs


def _scenario(name: str) -> Callable[[Path], None]:
    return toml_seed((ROOT / "scenarios/library" / f"{name}.toml").read_text(encoding="utf-8"))


def _claim(name: str) -> Callable[[Path], None]:
    return toml_seed((CLAIMS / f"{name}.toml").read_text(encoding="utf-8"))


def _plan(folder: Path) -> None:
    toml_seed((ROOT / "docs/examples/plan_room.toml").read_text(encoding="utf-8"))(folder)


def _template(folder: Path) -> Any:
    read = read_template(folder / "a.toml")
    middle = [k for k, name in enumerate(read.names) if read.other_side[k] == k and name]
    return {
        "names": sorted(read.names),
        "place": {read.names[k]: read.place_m[k] for k in middle},
        "share": {read.names[k]: read.share[k] for k in range(len(read.names))},
        "segments": {read.names[k]: read.segment_names[read.segment[k]] for k in middle},
    }


def _template_expected(folder: Path) -> Any:
    marks = document(folder / "a.toml")["marker"]
    both = [(name, one) for one in marks for name in (one["name"], one.get("other_side")) if name is not None]
    alone = [one for one in marks if one.get("other_side") is None]
    return {
        "names": sorted(name for name, _ in both),
        "place": {one["name"]: np.array(one["place_m"], float) for one in alone},
        "share": {name: one.get("share", 0.97) for name, one in both},
        "segments": {one["name"]: one["segment"] for one in alone},
    }


def _surface(folder: Path) -> Any:
    read = read_surface_model(folder / "a.toml")
    return {"places": dict(zip(read.names, read.place_m, strict=True)), "size": read.size_sigma}


def _surface_expected(folder: Path) -> Any:
    read = document(folder / "a.toml")
    places = {one["name"]: np.array(one["place_m"], float) for one in read["marker"]}
    for one in read["marker"]:
        if one.get("other_side") is not None:
            places[one["other_side"]] = np.array(one["place_m"], float) * [1, -1, 1]
    return {"places": places, "size": float(read["size_sigma"])}


FILES = ("a.toml",)
READERS = (
    Reader("rig", (_rig_seed,), FILES, lambda folder: values_of(read_rig(folder / "a.toml")), _rig_expected),
    Reader("hardware", (toml_seed(HARDWARE),), FILES, lambda f: _hardware(f)[0], lambda f: _hardware(f)[1]),
    *(
        Reader(f"target {kind}", (toml_seed(text),), FILES, _target, _target_expected)
        for kind, text in TARGETS.items()
    ),
    Reader("measured points", (_points_seed,), ("a.toml", "left.txt"), _points, _points_expected),
    Reader("bodies", (_bodies_seed,), FILES, _bodies, _bodies_expected),
    Reader("marker model", (toml_seed(MODEL),), FILES, _model, _model_expected),
    Reader(
        "marker template", (toml_seed(STANDARD.read_text(encoding="utf-8")),), FILES, _template, _template_expected
    ),
    Reader("surface model", (toml_seed(FACE.read_text(encoding="utf-8")),), FILES, _surface, _surface_expected),
    Reader("scenario", tuple(map(_scenario, ("spaces/space_1m", "delivery/bursts"))), FILES, *_models(load_scenario)),
    Reader("claim", tuple(map(_claim, ("space_1m", "quick_cloud"))), FILES, *_models(load_claim)),
    Reader("plan", (_plan,), FILES, *_models(load_plan)),
    Reader("lab", (toml_seed(LAB),), FILES, *_models(read_lab)),
    Reader("program", (toml_seed(PROGRAM),), FILES, *_models(read_program)),
    Reader("stream faults", (toml_seed(FAULTS),), FILES, *_models(read_faults)),
    Reader("lamps", (toml_seed(LAMPS),), FILES, _lamps, _lamps_expected),
    Reader("track edits", (toml_seed(TRACK_EDITS),), FILES, *_edits(read_track_edits)),
    Reader("motion edits", (toml_seed(MOTION_EDITS),), FILES, *_edits(read_motion_edits)),
    Reader("marker table", (toml_seed(MARKERS, "a.csv"),), ("a.csv",), _markers, _markers_expected),
)
