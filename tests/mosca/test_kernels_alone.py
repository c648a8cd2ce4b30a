"""Functions compiled without a Python wrapper crash when called from Python: no code does so."""

import ast
import importlib
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, ModuleType

import mosca
import twin

TESTS = Path(__file__).parents[1]


def codes(code: CodeType) -> Iterator[CodeType]:
    """Yield a code object and all nested ones."""
    yield code
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from codes(one)


def functions(module: ModuleType) -> Iterator[CodeType]:
    """Yield the code of a module's functions and methods, but not of what is compiled."""
    for one in vars(module).values():
        for member in [one, *vars(one).values()] if isinstance(one, type) else [one]:
            code = getattr(getattr(member, "__func__", member), "__code__", None)
            if isinstance(code, CodeType) and not hasattr(member, "targetoptions"):
                yield from codes(code)


def alone(one: object) -> bool:
    """Return whether an object is compiled for other kernels only."""
    return bool(getattr(one, "targetoptions", {}).get("no_cpython_wrapper"))


def called_by_python(module: ModuleType) -> list[str]:
    """Name what a module's plain functions use of what is compiled for other kernels only."""
    names = {name for name, one in vars(module).items() if alone(one)}
    return [f"{module.__name__}.{c.co_name}: {n}" for c in functions(module) for n in names & {*c.co_names}]


def called_by_tests(source: str) -> list[str]:
    """Name what a file's functions that are not compiled call of what it imports and is for other kernels only."""
    tree = ast.parse(source)
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("mosca", "twin"):
            module = importlib.import_module(str(node.module))
            names |= {
                one.asname or one.name: one.name for one in node.names if alone(getattr(module, one.name, None))
            }
    found = []
    waiting: list[ast.AST] = [tree]
    while names and waiting:
        node = waiting.pop()
        decorators = [ast.unparse(one) for one in getattr(node, "decorator_list", ())]
        if any("kernel" in one or "njit" in one for one in decorators):
            continue
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in names:
            found.append(node.func.id)
        waiting += ast.iter_child_nodes(node)
    return found


def test_only_kernels_call_what_is_compiled_for_kernels_alone() -> None:
    found = [m.name for room in (mosca, twin) for m in pkgutil.walk_packages(room.__path__, f"{room.__name__}.")]
    modules = [importlib.import_module(name) for name in found]
    assert sum(alone(one) for module in modules for one in vars(module).values()) > 50
    assert [call for module in modules for call in called_by_python(module)] == []


def test_no_test_calls_what_is_compiled_for_kernels_alone() -> None:
    files = [*TESTS.rglob("*.py"), *(TESTS.parent / "witness").rglob("*.py")]
    assert {path.name: calls for path in files if (calls := called_by_tests(path.read_text(encoding="utf-8")))} == {}
    planted = "from twin.cameras.render.boundary_integral import nodes_for\ndef f():\n    return nodes_for(1.0)\n"
    assert called_by_tests(planted) == ["nodes_for"]


def test_a_call_from_python_is_found() -> None:
    planted = ModuleType("planted")
    exec(
        "from mosca.correspondence.spatial_index import cell_of\n"
        "class A:\n    def f(self):\n        return [cell_of(k) for k in '1']",
        vars(planted),
    )
    assert {call.split(":")[1] for call in called_by_python(planted)} == {" cell_of"}
