"""The named float constants of ``mosca`` and what the code says of each, read from its syntax.

Listed is each module-level name whose value is made of float literals. Not listed, since they decide nothing about a
measurement: numbers of formats and of the vocabulary (``LEFT_OUT``), names in ``NOT_CHOSEN`` (mathematics, units,
numbers of models), and guards: values of at most 1e-6 or at least 1e6, which keep divisors from 0, say infinity, or
end an iteration at rounding. Class fields are settings, which have their own descriptions. Integers are counts.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
REACHED = (
    "mosca/detection", "mosca/correspondence", "mosca/tracking", "mosca/triangulation", "mosca/camera",
    "mosca/diagnostics", "mosca/synchronisation", "mosca/calibration", "mosca/coded_targets",
)  # fmt: skip
"""Packages of which the takes run something, in the order in which they are tried."""
LEFT_OUT = ("mosca/formats/", "mosca/data/", "mosca/precompile.py")
NOT_CHOSEN = {
    "mosca/accuracy/lab_twin/estimates.py::SPREAD": "mathematics",
    "mosca/accuracy/lab_twin/photon_transfer.py::ROUNDING_DN2": "mathematics",
    "mosca/accuracy/planning/image_noise.py::PIXEL_VARIANCE_PX2": "mathematics",
    "mosca/accuracy/planning/image_noise.py::TABLE_RATIOS": "points of a table",
    "mosca/accuracy/planning/objective.py::TWICE": "mathematics",
    "mosca/accuracy/planning/obstacles.py::GOLDEN": "mathematics",
    "mosca/accuracy/planning/obstacles.py::BOX": "number of a model",
    "mosca/accuracy/planning/obstacles.py::CYLINDER": "number of a model",
    "mosca/calibration/common/robust_fit.py::SIGMA_BY_MEDIAN_1D": "mathematics",
    "mosca/calibration/quality/scale.py::UNITS": "units",
    "mosca/calibration/world_frame/l_frame.py::UNITS": "units",
    "mosca/camera/lens_models/row.py::MOSCA": "number of a model",
    "mosca/camera/lens_models/row.py::OPENCV_PLAIN": "number of a model",
    "mosca/camera/lens_models/row.py::OPENCV_FULL": "number of a model",
    "mosca/camera/lens_models/row.py::FISHEYE": "number of a model",
    "mosca/coded_targets/board_view.py::NO_BEND": "no lens",
    "mosca/coded_targets/dots.py::COS": "mathematics",
    "mosca/coded_targets/dots.py::SIN": "mathematics",
    "mosca/coded_targets/dots.py::POLYGON": "mathematics",
    "mosca/continuous/comparison_methods/epipoles.py::QUARTER_ROTATION": "mathematics",
    "mosca/correspondence/hypothesis.py::AREAS": "number of a rule",
    "mosca/correspondence/hypothesis.py::SIZES": "number of a rule",
    "mosca/correspondence/hypothesis.py::SHAPES": "number of a rule",
    "mosca/correspondence/typical_size.py::LARGEST": "mathematics",
    "mosca/detection/disc_fit/row.py::BY_EVEN_NOISE": "mathematics",
    "mosca/detection/disc_fit/row.py::BY_SHOT_NOISE": "mathematics",
    "mosca/detection/disc_fit/row.py::FITTED_RADII": "points of a table",
    **dict.fromkeys((f"mosca/detection/disc_fit/disc_image.py::P{k}" for k in range(5)), "mathematics"),
    **dict.fromkeys((f"mosca/detection/disc_fit/disc_image.py::Q{k}" for k in range(5)), "mathematics"),
    "mosca/detection/cut_targets/disc.py::_DENSITY": "mathematics",
    "mosca/detection/cut_targets/disc.py::_E": "mathematics",
    "mosca/detection/cut_targets/disc.py::_HALF": "mathematics",
    "mosca/detection/cut_targets/disc.py::_ONE": "mathematics",
    "mosca/detection/cut_targets/disc.py::_PHI": "mathematics",
    "mosca/detection/disc_fit/disc_image.py::HALF": "mathematics",
    "mosca/detection/disc_fit/first_values.py::NO_STRETCH": "no map",
    "mosca/detection/disc_fit/light_offset.py::HALF_DIAGONAL": "mathematics",
    **dict.fromkeys((f"mosca/detection/merged_targets/fit.py::A{k}" for k in range(1, 6)), "mathematics"),
    "mosca/diagnostics/sensor.py::MEDIAN_LOSS": "mathematics",
    "mosca/labelling/surface/model.py::_MIRROR": "mathematics",
    "mosca/skeleton/naming.py::MEDIAN": "mathematics",
    "mosca/smoothing/gap_filling.py::CHI2_95": "mathematics",
    "mosca/tracking/kalman.py::EXPECTED_NIS": "mathematics",
}
ABOUT_ONE = {
    "mosca/coded_targets/boards.py::LEAST_ALTERNATING", "mosca/coded_targets/boards.py::LEAST_FITTING",
    "mosca/coded_targets/decode.py::LEANING", "mosca/coded_targets/dots.py::MOST_SOLID",
    "mosca/coded_targets/ring_sampling.py::LEAST_LIKENESS", "mosca/correspondence/hypothesis.py::ODD_SHIFT",
    "mosca/correspondence/hypothesis.py::TOO_LARGE", "mosca/correspondence/nearest_ray.py::FIRST_ORDER",
    "mosca/correspondence/nearest_ray.py::SAME_SIDE", "mosca/detection/disc_fit/row.py::MISFIT_MEAN",
    "mosca/detection/disc_fit/first_values.py::MOST_STRETCHED", "mosca/detection/disc_fit/profile.py::SETTLED",
    "mosca/diagnostics/long_run_covariance.py::MOST_PERSISTENT", "mosca/diagnostics/sensor.py::CONFIDENCE",
}  # fmt: skip
"""Cosines, probabilities and ratios of which the distance from 1 is what was chosen: a trial scales that."""
SMALL, LARGE = 1e-6, 1e6
"""Values that are no larger, or no smaller, guard."""
SOURCE = re.compile(
    r"\b(1[89]|20)\d\d\b|docs/|EMVA|ISO |quantile|probabilit|chance|by chance|in [\d,]*000\b|derived|false-positive"
    r"|efficiency for normal|closed form|a few ulp|standard deviations? of (a|the) normal",
    re.IGNORECASE,
)
"""Words of a source or a derivation: a year of a publication, a standard, a probability."""
OUTCOME = re.compile(
    r"\(measured|\bmeasured (at|on|with)\b|half or twice|twice or half|at half|at twice"
    r"|\bwith (half|twice|\d[\d.]*)\b[^.]*\b(gives?|gave|leaves?|makes?)"
    r"|\bwith \d[\d.]*(, \d[\d.]*)*,? and \d|\bwith \d[\d.]*, "
    r"|\bat \d[\d.]*(, \d[\d.]*)* (and|gives?|are|come)|\b\d[\d.]* gives? ",
    re.IGNORECASE,
)
"""Words of an outcome at other values."""


@dataclass(frozen=True)
class Constant:
    """One name with its value as written, and what is said of it."""

    file: str
    """Path below the root."""
    name: str
    line: int
    value: str
    """The expression."""
    number: float | None
    """Its value where it is one number."""
    words: str
    """What docstring or comment say; empty where nothing is said."""

    @property
    def key(self) -> str:
        """File and name."""
        return f"{self.file}::{self.name}"

    @property
    def package(self) -> str:
        """Folder or module of ``mosca``."""
        return "/".join(self.file.split("/")[:2]).removesuffix(".py")

    @property
    def told(self) -> str:
        """The first sentence of the words."""
        return re.split(r"(?<=[a-z0-9)\]%`\"])\.(?=\s+[A-Z(]|$)", self.words, maxsplit=1)[0].rstrip(".")

    @property
    def stands_on(self) -> str:
        """``outcome``, ``source``, ``words`` or ``nothing``: the best that the words hold."""
        if OUTCOME.search(self.words):
            return "outcome"
        return "source" if SOURCE.search(self.words) else "words" if self.words else "nothing"


def constants(root: Path = ROOT) -> list[Constant]:
    """Return the constants of ``mosca`` below ``root``, in order of files and lines."""
    found = []
    for path in sorted((root / "mosca").rglob("*.py")):
        file = path.relative_to(root).as_posix()
        if not file.startswith(LEFT_OUT):
            found += [one for one in constants_of(path.read_text(encoding="utf-8"), file) if _is_chosen(one)]
    return found


def constants_of(text: str, file: str) -> list[Constant]:
    """Return all constants of float literals in a module's text."""
    tree, lines = ast.parse(text), text.splitlines()
    found = []
    for statement, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        words = _words(statement, after, lines)
        for name, value in _named(statement):
            if _floats(value):
                found.append(
                    Constant(
                        file, name, statement.lineno, " ".join(ast.unparse(value).split()), _number(value), words
                    )
                )
    return found


def _is_chosen(one: Constant) -> bool:
    if one.key in NOT_CHOSEN:
        return False
    numbers = [abs(v) for v in _floats(ast.parse(one.value, mode="eval").body)]
    return any(SMALL < v < LARGE for v in numbers)


def _named(statement: ast.stmt) -> Iterator[tuple[str, ast.expr]]:
    """Yield names and values of an assignment; of ``A, B = 1.0, 2.0`` both."""
    if isinstance(statement, ast.AnnAssign) and statement.value is not None:
        target, value = statement.target, statement.value
    elif isinstance(statement, ast.Assign) and len(statement.targets) == 1:
        target, value = statement.targets[0], statement.value
    else:
        return
    if isinstance(target, ast.Name):
        yield target.id, value
    elif isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        for one, own in zip(target.elts, value.elts, strict=True):
            if isinstance(one, ast.Name):
                yield one.id, own


def _floats(value: ast.AST) -> list[float]:
    return [n.value for n in ast.walk(value) if isinstance(n, ast.Constant) and isinstance(n.value, float)]


def _number(value: ast.expr) -> float | None:
    """Return the number of a literal, with its sign or as ``f32(literal)``."""
    if isinstance(value, ast.Call) and len(value.args) == 1 and ast.unparse(value.func) in ("f32", "float"):
        return _number(value.args[0])
    try:
        number = ast.literal_eval(value)
    except ValueError:
        return None
    return number if isinstance(number, float) else None


def _words(statement: ast.stmt, after: ast.stmt | None, lines: list[str]) -> str:
    """Return the docstring below a statement, else the comment on its line, else that above it."""
    if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
        return " ".join(after.value.value.split())
    first, last = statement.lineno - 1, (statement.end_lineno or statement.lineno) - 1
    comment = re.search(r"\s# ?(?!fmt|noqa|type:)(.*)$", lines[last])
    if comment:
        return comment.group(1).strip()
    above: list[str] = []
    while first > 0 and lines[first - 1].startswith("#"):
        first -= 1
        above.insert(0, lines[first].lstrip("# "))
    return " ".join(above)
