"""``docs/constants.md``: a table a package, made of the constants' own words and of kept outcomes."""

from collections import Counter
from collections.abc import Sequence

from tests.studies.constants.inventory import REACHED, ROOT, Constant
from tests.studies.constants.outcomes import Outcomes
from tests.studies.constants.screen import ABSOLUTE, OTHERS, RELATIVE

PAGE = ROOT / "docs" / "constants.md"
HEAD = """# Constants

This page lists each float constant that decides something in the product: its description from the code, the basis
of its value, and the effect of half and of twice the value on headline figures. Not listed are guards against
divisions by zero, ends of iterations at rounding, units, mathematics and counts. Settings are not listed either: they
have their own descriptions ([Files](reference/index.md)).

`python -m tests.studies.constants page` writes this page; a test compares it with the code.

The column *stands on* states the basis of the value:

- **outcome**: the description states the results of other values;
- **source**: a publication, a standard, a probability or a derivation;
- **trial**: takes reach the constant, and half and twice its value were tried;
- **words**: the description states what the value trades off, and no more.

The columns *half* and *twice* state the effect of one changed constant, with all else as it is:

- *flat*: no figure moved by more than {flat};
- *same*: no figure moved at all, not in the last digit. The takes do not reach the constant, or it decides nothing in
  them;
- otherwise the figures that moved most. An empty cell: not tried.
""".format(
    flat=", ".join(
        [f"{v:g} ({k})" for k, v in ABSOLUTE.items()] + [f"{100 * v:g} % ({k})" for k, v in RELATIVE.items()]
    )
    + f", {100 * OTHERS:g} % (others)"
)


def page(constants: Sequence[Constant], outcomes: Outcomes) -> str:
    """Return the page."""
    counts = Counter(ground(one, outcomes) for one in constants)
    parts = [
        HEAD,
        _tried(outcomes, constants),
        "| package | constants | outcome | source | trial | words | nothing |",
    ]
    parts += ["|---|---|---|---|---|---|---|"]
    packages = list(dict.fromkeys(one.package for one in constants))
    kinds = ("outcome", "source", "trial", "words", "nothing")
    for package in packages:
        by = Counter(ground(one, outcomes) for one in constants if one.package == package)
        parts.append(f"| {package} | {by.total()} | " + " | ".join(str(by[kind]) for kind in kinds) + " |")
    parts.append(f"| **all** | {counts.total()} | " + " | ".join(str(counts[kind]) for kind in kinds) + " |")
    for package in packages:
        parts += ["", f"## {package}", "", "| constant | value | words | stands on | half | twice |"]
        parts.append("|---|---|---|---|---|---|")
        parts += [_row(one, outcomes) for one in constants if one.package == package]
    return "\n".join(parts) + "\n"


def ground(one: Constant, outcomes: Outcomes) -> str:
    """Return on what a constant stands: ``trial`` where its words have neither source nor outcome but takes do."""
    of = outcomes.single.get(one.key, {})
    tried = len(of) >= 2 and any(moved is not None for moved in of.values())
    return "trial" if tried and one.stands_on == "words" else one.stands_on


def _tried(outcomes: Outcomes, constants: Sequence[Constant]) -> str:
    if not outcomes.single and not outcomes.flat:
        return ""
    there = {one.key for one in constants}
    single = {key: of for key, of in outcomes.single.items() if key in there}
    lines = [
        f"Tried on {outcomes.date} at commit {outcomes.commit}, with the takes {', '.join(outcomes.takes)}. "
        "The word outside marks images that the project's own twin did not make."
    ]
    if single:
        reached = {k: of for k, of in single.items() if any(moved is not None for moved in of.values())}
        moved = [k for k, of in reached.items() if any(of.values())]
        lines.append(
            f"Changed alone: {len(single)} constants. Of these, {len(single) - len(reached)} change no figure at "
            f"either value, {len(reached) - len(moved)} are flat at both, {len(moved)} move a figure."
        )
    for factor, groups in outcomes.flat.items():
        many = outcomes.matters.get(factor, [])
        alone = [one for one in many if " + " not in one]
        asked = {key for group in (*groups, *(one.split(" + ") for one in many)) for key in group}
        left = sum(one.package in REACHED and one.key not in asked for one in constants)
        listed = ", ".join(f"`{one.removeprefix('mosca/')}`" for one in alone) or "none"
        lines.append(
            f"Changed in groups, times {factor}; a group that moved figures was bisected. {sum(map(len, groups))} "
            f"constants are flat, in {len(groups)} groups. Larger groups that move figures although neither of their "
            f"halves does: {len(many) - len(alone)}. Constants that move figures alone: {listed}. {left} others of "
            "the packages that the takes run were not tried, or not to the end."
        )
    return "\n\n".join(lines) + "\n"


def _row(one: Constant, outcomes: Outcomes) -> str:
    path = one.file.removeprefix(one.package).strip("/").removesuffix(".py")
    name = f"`{path}` {one.name}" if path else one.name
    cells = [name, f"`{one.value}`", one.told, ground(one, outcomes)]
    cells += [_outcome(outcomes.single.get(one.key, {}), factor) for factor in ("0.5", "2")]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _outcome(of: dict[str, list[str] | None], factor: str) -> str:
    if factor not in of:
        return ""
    moved = of[factor]
    return "same" if moved is None else "; ".join(moved) if moved else "flat"
