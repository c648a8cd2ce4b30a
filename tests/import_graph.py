"""Imports between the entries (files and folders) of a package, as a graph. Used by test_architecture."""

import ast
from collections import defaultdict
from pathlib import Path

Arrows = dict[str, set[str]]


def arrows(root: Path, package: str, inside_functions: bool = False) -> Arrows:
    """Return entry -> entries it imports from, of the files and folders directly below ``package`` (dotted).

    Imports under ``if TYPE_CHECKING`` do not count; those inside functions only if requested.
    """
    found: Arrows = defaultdict(set)
    folder = root.joinpath(*package.split("."))
    for path in sorted(folder.rglob("*.py")):
        here = path.relative_to(folder).with_suffix("").parts
        if here == ("__init__",):
            continue
        for name in _imports(ast.parse(path.read_text(encoding="utf-8")), inside_functions):
            parts = name.split(".")
            if ".".join(parts[: package.count(".") + 1]) == package and len(parts) > package.count(".") + 1:
                there = parts[package.count(".") + 1]
                if there != here[0] and _is_entry(folder, there):
                    found[here[0]].add(there)
    return found


def cycle(graph: Arrows) -> list[str]:
    """Return one cycle of the arrows, its first entry again at the end; empty where there is none."""
    state: dict[str, int] = {}

    def visit(entry: str, way: list[str]) -> list[str]:
        state[entry] = 1
        for there in sorted(graph.get(entry, ())):
            if state.get(there) == 1:
                return [*way[way.index(there) :], there] if there in way else [entry, there]
            if there not in state and (found := visit(there, [*way, there])):
                return found
        state[entry] = 2
        return []

    for entry in sorted(graph):
        if entry not in state and (found := visit(entry, [entry])):
            return found
    return []


def _imports(tree: ast.Module, inside_functions: bool) -> list[str]:
    names: list[str] = []
    waiting: list[ast.AST] = list(tree.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
            continue
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and not inside_functions:
            continue
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        waiting += ast.iter_child_nodes(node)
    return names


def _is_entry(folder: Path, name: str) -> bool:
    return (folder / f"{name}.py").exists() or (folder / name / "__init__.py").exists()
