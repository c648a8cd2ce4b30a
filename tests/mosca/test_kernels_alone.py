"""Functions compiled without a Python wrapper crash when called from Python: no code does so."""

import importlib
import pkgutil
from collections.abc import Iterator
from types import CodeType, ModuleType

import mosca


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


def test_only_kernels_call_what_is_compiled_for_kernels_alone() -> None:
    found = [m.name for m in pkgutil.walk_packages(mosca.__path__, "mosca.")]
    modules = [importlib.import_module(name) for name in found]
    assert sum(alone(one) for module in modules for one in vars(module).values()) > 50
    assert [call for module in modules for call in called_by_python(module)] == []


def test_a_call_from_python_is_found() -> None:
    planted = ModuleType("planted")
    exec(
        "from mosca.correspondence.spatial_index import cell_of\n"
        "class A:\n    def f(self):\n        return [cell_of(k) for k in '1']",
        vars(planted),
    )
    assert {call.split(":")[1] for call in called_by_python(planted)} == {" cell_of"}
