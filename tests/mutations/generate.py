"""Draw mutants from a seed: operators and numbers of random places in functions of the product.

    python -m tests.mutations.generate --seed 19 > tests/mutations/generated.toml

Comparisons are turned round, sums and products exchanged with differences and quotients, ``and`` with ``or``, numbers
doubled, signs and negations left out. Each room has its share and the tests that should notice it; tests that import
the changed module come first.
"""

import argparse
import ast
import random
import re
from collections.abc import Iterator
from pathlib import Path

from tests.mutations.mutant import ROOT

SPACE = "scenarios/library/spaces/space_1m.toml"
SHARES = {
    "mosca/detection": (6, "refine refine_pair detect detection_noise static_background profile", (SPACE,)),
    "mosca/correspondence": (3, "match match_agreement flat_targets", (SPACE,)),
    "mosca/tracking": (3, "track track_limbs", (SPACE,)),
    "mosca/camera": (3, "lens_models camera eccentricity_ball flat_targets", ()),
    "mosca/calibration/bundle": (3, "bundle bundle_jacobian bundle_statistics systematic_errors intervals", ()),
    "mosca/rigid_bodies": (2, "bodies rigid", ()),
    "twin/cameras": (
        5,
        "source lens lighting mount sensor sensor_noise shutter stray context",
        ("tests/oracle/test_render_witness.py", "tests/oracle/test_shutter_witness.py", SPACE),
    ),
    "scenarios/score": (3, "score self_checks run_scenario", (SPACE,)),
    "hardware": (
        3,
        "hardware_source numbering counting late_pulses transport_messages transport_clock transport_merger",
        (),
    ),
}
"""Room: number of mutants, and what should notice them: tests of the room by name, and others."""
NOT_DRAWN = ("hardware/drivers/", "hardware/firmware/", "hardware/emulate/", "hardware/onboard/")
"""Need devices or packages that not everyone has."""
SWAPPED = {
    ast.Lt: ">", ast.Gt: "<", ast.LtE: ">=", ast.GtE: "<=", ast.Eq: "!=", ast.NotEq: "==", ast.Add: "-", ast.Sub: "+",
    ast.Mult: "/", ast.Div: "*", ast.And: "or", ast.Or: "and",
}  # fmt: skip

GUARD = 1e-6
"""Smaller numbers guard against divisions by zero, those above its inverse against infinity: twice is as good."""

Change = tuple[int, int, int, str]
"""Line, first and end column, and what stands there instead."""


def changes_of(tree: ast.AST) -> Iterator[Change]:
    """Yield every change that can be made in the functions of a module, but for what they say when they refuse."""
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                yield from _changes(statement)


def _changes(node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.FunctionDef | ast.Assert):
        return
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        yield from _between(node.left, node.ops[0], node.comparators[0])
    elif isinstance(node, ast.BinOp):
        yield from _between(node.left, node.op, node.right)
    elif isinstance(node, ast.BoolOp) and len(node.values) == 2:
        yield from _between(node.values[0], node.op, node.values[1])
    elif isinstance(node, ast.Constant) and isinstance(node.value, float) and GUARD < node.value < 1.0 / GUARD:
        yield node.lineno, node.col_offset, node.end_col_offset or 0, repr(2.0 * node.value)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        yield node.lineno, node.col_offset, node.operand.col_offset, ""
    for child in ast.iter_child_nodes(node):
        yield from _changes(child)


def _between(left: ast.expr, operator: ast.AST, right: ast.expr) -> Iterator[Change]:
    if type(operator) in SWAPPED and left.end_lineno == right.lineno:
        yield right.lineno, left.end_col_offset or 0, right.col_offset, SWAPPED[type(operator)]


def mutated_lines(lines: list[str], change: Change) -> str:
    """Return the line with the change made; brackets and blanks about an operator stay."""
    row, first, end, new = change
    line = lines[row - 1]
    middle = line[first:end]
    if (new and any(mark in middle for mark in "<>=!+-*/")) or middle.strip(" ()") in ("and", "or"):
        old = middle.strip(" ()")
        middle = middle.replace(old, new, 1)
    else:
        middle = new
    return line[:first] + middle + line[end:]


def unique_text(lines: list[str], row: int) -> tuple[int, str]:
    """Return the first row, and the text from there to ``row``, that stands in the file once."""
    whole = "\n".join(lines)
    first = row
    while whole.count("\n".join(lines[first - 1 : row])) > 1:
        first -= 1
    return first, "\n".join(lines[first - 1 : row])


def drawn(room: str, count: int, dice: random.Random) -> Iterator[tuple[str, str, str]]:
    """Yield file, old and new text of mutants of a room, each of another file."""
    files = sorted(
        path.relative_to(ROOT).as_posix() for path in (ROOT / room).rglob("*.py") if path.name != "__init__.py"
    )
    files = [name for name in files if not name.startswith(NOT_DRAWN)]
    dice.shuffle(files)
    for name in files:
        if count == 0:
            return
        text = (ROOT / name).read_text()
        lines, found = text.split("\n"), list(changes_of(ast.parse(text)))
        if not found or not text.isascii():
            continue
        change = dice.choice(found)
        first, old = unique_text(lines, change[0])
        new = "\n".join([*lines[first - 1 : change[0] - 1], mutated_lines(lines, change)])
        yield name, old, new
        count -= 1


def importing(name: str) -> list[str]:
    """Return the test files of the same room that import the module in the file ``name``."""
    module = name.removesuffix(".py").replace("/", ".")
    package, _, member = module.rpartition(".")
    whole, part = (re.escape(text) for text in (module, package))
    wanted = re.compile(rf"^from (?:{whole} import|{part} import .*\b{member}\b)", re.MULTILINE)
    files = sorted((ROOT / "tests" / name.split("/")[0]).rglob("test_*.py"))
    return [path.relative_to(ROOT).as_posix() for path in files if wanted.search(path.read_text())]


def main() -> None:
    """Print the list of a seed."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations.generate", description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=19)
    dice = random.Random(parser.parse_args().seed)
    print("# Drawn by `python -m tests.mutations.generate`; mutants that change nothing are marked there.")
    for room, (count, words, others) in SHARES.items():
        tests = [f"tests/{room.split('/')[0]}/test_{word}.py" for word in words.split()] + list(others)
        for name, old, new in drawn(room, count, dice):
            title = f"{room.replace('/', '_')}_{Path(name).stem}"
            quoted = ", ".join(f'"{test}"' for test in dict.fromkeys([*importing(name), *tests]))
            print(f"\n[{title}]\nfile = \"{name}\"\nold = '''\n{old}'''\nnew = '''\n{new}'''\ntests = [{quoted}]")


if __name__ == "__main__":
    main()
