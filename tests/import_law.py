"""Reads a tree's imports and holds them against the law of DESIGN section 3. Used by test_architecture."""

import ast
from pathlib import Path

ROOMS = ("mosca", "twin", "hardware", "reports", "scenarios", "witness")

HARDWARE = ("hardware", "mosca.data", "mosca.errors")
# package (longest prefix wins): packages it may import from, packages or modules it may not, third-party ones
LAW: dict[str, tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]] = {
    "mosca.data": (("mosca.data", "mosca.errors"), (), ("numpy", "scipy", "pydantic", "tomli_w")),
    "mosca": (
        ("mosca",),
        ("mosca.data.truth",),
        ("numpy", "scipy", "cv2", "numba", "pydantic", "tomli_w", "mcap", "blosc2", "av", "ezc3d", "zstandard"),
    ),
    # a model of a person is MuJoCo's: its kinematics and derivatives
    "mosca.skeleton": (
        ("mosca",),
        ("mosca.data.truth",),
        (
            "numpy",
            "scipy",
            "cv2",
            "numba",
            "pydantic",
            "tomli_w",
            "mcap",
            "blosc2",
            "av",
            "ezc3d",
            "zstandard",
            "mujoco",
        ),
    ),
    # a second opinion on a linear model comes from the control library
    "mosca.machines.identification": (("mosca",), ("mosca.data.truth",), ("numpy", "scipy", "control")),
    # the search for places of cameras: CMA-ES
    "mosca.accuracy.planning.search": (("mosca",), ("mosca.data.truth",), ("numpy", "scipy", "cma")),
    # tables with types: Parquet comes from the library that rerun brings along
    "mosca.formats.tracks.parquet": (("mosca",), ("mosca.data.truth",), ("numpy", "pyarrow")),
    # bags are written by the library that knows ROS 2's encoding
    "mosca.formats.ros2.bag": (("mosca",), ("mosca.data.truth",), ("numpy", "mcap_ros2")),
    # a printable sheet is a drawing: PDF and SVG come from the plot library
    "mosca.formats.sheets.target_sheet": (("mosca",), ("mosca.data.truth",), ("numpy", "matplotlib")),
    # the twin shares with the pipeline how code is compiled, and no formula
    "twin": (
        ("twin", "mosca.data", "mosca.errors", "mosca.numba_support.decorators"),
        (),
        ("mujoco", "trimesh", "numpy", "scipy", "numba", "cv2", "pydantic"),
    ),
    "hardware": (HARDWARE, ("mosca.data.truth",), ("numpy", "pydantic")),
    # what is streamed is data: of the pipeline it knows no formula
    "hardware.streams": (
        ("hardware.streams", "mosca.data", "mosca.errors"),
        ("mosca.data.truth",),
        ("numpy", "pydantic"),
    ),
    "hardware.streams.lsl.outlets": (
        ("hardware.streams", "mosca.data", "mosca.errors"),
        ("mosca.data.truth",),
        ("numpy", "pylsl"),
    ),
    "hardware.streams.foxglove_server": (
        ("hardware.streams", "mosca.data", "mosca.errors"),
        ("mosca.data.truth",),
        ("numpy", "foxglove"),
    ),
    "hardware.drivers.pylon": (HARDWARE, ("mosca.data.truth",), ("numpy", "pypylon")),
    "hardware.drivers.gentl": (HARDWARE, ("mosca.data.truth",), ("numpy", "harvesters", "genicam")),
    "hardware.drivers.webcam": (HARDWARE, ("mosca.data.truth",), ("numpy", "cv2")),
    "hardware.triggers.serial_box": (HARDWARE, ("mosca.data.truth",), ("numpy", "serial")),
    "hardware.transport.zenoh_engine": (HARDWARE, ("mosca.data.truth",), ("numpy", "zenoh")),
    "reports": (
        ("reports", "mosca.data", "mosca.errors"),
        (),
        ("numpy", "matplotlib", "mpl_toolkits", "jinja2", "markupsafe", "rich"),
    ),
    "reports.playback.keeper": (("reports", "mosca.data", "mosca.errors"), (), ("numpy", "PIL")),
    "reports.viewer": (("reports", "mosca.data", "mosca.errors"), (), ("numpy", "rerun", "cv2")),
    "reports.fidelity_page": (("reports", "mosca.data", "mosca.errors"), (), ("cv2",)),
    # a certificate as PDF: the library that writes it is known here alone
    "reports.certificate.pdf": (("reports", "mosca.data", "mosca.errors"), (), ("matplotlib", "fpdf")),
    "witness": (("witness",), (), ("numpy", "scipy", "cv2", "mujoco")),
    "witness.mitsuba": (("witness",), (), ("numpy", "scipy", "cv2", "mitsuba", "drjit")),
    "witness.gl": (("witness",), (), ("numpy", "scipy", "mujoco", "pyrender", "trimesh")),
    "scenarios.fidelity": (ROOMS, (), ("numpy", "scipy", "mujoco", "trimesh")),
    # tracked bodies move what is in a second MuJoCo scene
    "scenarios.virtual.scene": (ROOMS, (), ("numpy", "mujoco", "trimesh")),
    "scenarios": (
        ROOMS,
        (),
        ("numpy", "scipy", "llvmlite", "pydantic", "tomli_w", "click", "rich", "junitparser", "pytest", "SALib"),
    ),
    # adapters run in an entrant's environment: what they import is that entrant, and nothing of this project
    "scenarios.studies.benchmark.entrants": ((), (), ("numpy", "contract")),
    "scenarios.studies.benchmark.entrants.opencv_dlt": ((), (), ("numpy", "contract", "cv2")),
    "scenarios.studies.benchmark.entrants.trackpy_dlt": (
        (),
        (),
        ("numpy", "contract", "opencv_dlt", "cv2", "trackpy"),
    ),
    "scenarios.studies.benchmark.entrants.aniposelib_dlt": ((), (), ("numpy", "contract", "cv2", "aniposelib")),
    "scenarios.studies.benchmark.entrants.pose2sim_dlt": ((), (), ("numpy", "contract", "cv2", "Pose2Sim")),
    "scenarios.studies.benchmark.entrants.openptv_full": ((), (), ("numpy", "contract", "optv", "PIL")),
    # ours sees what its users see
    "scenarios.studies.benchmark.entrants.mosca_default": (("mosca",), ("mosca.data.truth",), ("numpy", "contract")),
    # verdicts are computed from numbers alone
    "scenarios.studies.campaign.statistics": (
        ("scenarios.studies.campaign.statistics", "mosca.data.arrays"),
        (),
        ("numpy", "scipy"),
    ),
    # what runs tasks on other computers is known here alone
    "scenarios.studies.campaign.cluster": (ROOMS, (), ("distributed",)),
    # its errors name the key that was given: only pydantic's core makes them
    "scenarios.spec.limits": (("reports.metrics",), (), ("pydantic", "pydantic_core")),
}
IMPORTLIB_ALLOWED = ("scenarios", "hardware.drivers")


def violations(root: Path) -> list[str]:
    """Return one line for each import below ``root`` that the law forbids."""
    found = []
    for room in ROOMS:
        for path in sorted((root / room).rglob("*.py")):
            module = ".".join(path.relative_to(root).with_suffix("").parts)
            found += [f"{module}: {what}" for what in _of_file(path, module)]
    return found


def _of_file(path: Path, module: str) -> list[str]:
    law = LAW[max((room for room in LAW if _within(module, room)), key=len)]
    complaints = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        for name in _imported(node):
            if name.startswith("."):
                complaints.append(f"relative import {name}")
                continue
            reason = _forbidden(name, module, law)
            if reason:
                complaints.append(reason)
    return complaints


def _imported(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        if node.level:
            return ["." * node.level + (node.module or "")]
        # "from mosca.data import truth" names a module too
        return [f"{node.module}.{alias.name}" for alias in node.names]
    return []


def _forbidden(name: str, module: str, law: tuple[tuple[str, ...], ...]) -> str:
    rooms, never, packages = law
    top = name.split(".")[0]
    if top in ROOMS:
        if any(_within(name, room) for room in never):
            return f"must not import {name}"
        if not any(_within(name, room) for room in rooms):
            return f"may not import from {name}; allowed: {', '.join(rooms)}"
        return ""
    if top == "importlib" and name != "importlib.metadata" and not name.startswith("importlib.metadata."):
        return "" if any(_within(module, room) for room in IMPORTLIB_ALLOWED) else "may not use importlib"
    if _is_standard(top) or top in packages:
        return ""
    return f"may not import the package {top}; allowed: {', '.join(packages)}"


def _is_standard(top: str) -> bool:
    import sys

    return top in sys.stdlib_module_names


def _within(name: str, room: str) -> bool:
    return name == room or name.startswith(room + ".")
