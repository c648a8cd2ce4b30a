"""Hands constants to compiled functions at run time, so that a changed one needs no compiling.

Numba freezes the globals of a function when it compiles it. Here each listed constant becomes, while its module is
imported, a number that knows its cell in a table; where a function that is compiled later uses it, the cell is read
instead (``BaseContext.get_constant_generic``). What Python alone runs sees a plain number, which ``set_values``
exchanges in all modules. Values that modules derive from others while they are imported, defaults of parameters and
arrays stay as they are.

Call ``install`` before anything of ``mosca`` is imported, with kernels kept in a folder of their own
(``NUMBA_CACHE_DIR``): those have addresses of this process in them.
"""

import ast
import ctypes
import sys
from collections.abc import Iterable, Mapping
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.base import BaseContext

from tests.studies.constants.inventory import ABOUT_ONE

MOST = 4096
_cells = (ctypes.c_double * MOST)()
_keys: list[str] = []
"""Key of each cell."""
MARK = "_at_run_time"


class Number64(float):
    """A float with the number of its cell."""

    cell: int


class Number32(np.float32):
    """The same of single precision."""

    cell: int


def listed(key: str, value: Any) -> Any:
    """Return ``value`` with a cell for each number; what is neither a number nor a tuple of numbers as it is."""
    if isinstance(value, tuple) and all(isinstance(one, float) for one in value):
        return tuple(listed(key, one) for one in value)
    if type(value) not in (float, np.float64, np.float32):
        return value
    one: Any = Number32(value) if isinstance(value, np.float32) else Number64(value)
    one.cell = len(_keys)
    _cells[one.cell] = float(value)
    _keys.append(key)
    return one


def set_factors(factors: Mapping[str, float]) -> None:
    """Let each constant have its own value times its factor, by key; those not named have their own value.

    Of those in ``ABOUT_ONE`` the distance from 1 is scaled.
    """
    changed: dict[int, float] = {}
    for k, key in enumerate(_keys):
        if key in factors:
            changed[k] = 1.0 + factors[key] * (_cells[k] - 1.0) if key in ABOUT_ONE else factors[key] * _cells[k]
    for k, value in changed.items():
        _cells[k] = value
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] in ("mosca", "scenarios", "twin"):
            for attribute, value in list(vars(module).items()):
                new = _scaled(value, changed)
                if new is not value:
                    setattr(module, attribute, new)


def known_keys() -> set[str]:
    """Return the keys that have a cell: modules that were imported, and numbers that can be changed."""
    return set(_keys)


def _scaled(value: Any, changed: Mapping[int, float]) -> Any:
    """Return a module's value with the numbers of the ``changed`` cells; itself where there is none of them."""
    if isinstance(value, tuple) and value and any(isinstance(one, Number64 | Number32) for one in value):
        new = [_scaled(one, changed) for one in value]
        return value if all(a is b for a, b in zip(new, value, strict=True)) else tuple(new)
    if isinstance(value, Number64 | Number32) and value.cell in changed:
        return type(value).__mro__[1](changed[value.cell])
    return value


class _Loader(SourceFileLoader):
    """Runs a module whose constants are ``listed``."""

    keys: Mapping[str, str]
    """Names of the module's constants and their keys."""

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        tree = ast.parse(self.get_data(path), path)
        body: list[ast.stmt] = []
        for statement in tree.body:
            body.append(statement)
            for name in _assigned(statement):
                if name in self.keys:
                    call = f"{name} = __import__('sys').modules[{__name__!r}].listed({self.keys[name]!r}, {name})"
                    body.append(ast.copy_location(ast.parse(call).body[0], statement))
        tree.body = body
        return compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True)


def _assigned(statement: ast.stmt) -> Iterable[str]:
    targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
    for target in targets:
        for one in target.elts if isinstance(target, ast.Tuple) else [target]:
            if isinstance(one, ast.Name):
                yield one.id


class _Finder(MetaPathFinder):
    def __init__(self, by_module: Mapping[str, Mapping[str, str]]) -> None:
        self.by_module = by_module

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if fullname not in self.by_module:
            return None
        spec = PathFinder.find_spec(fullname, path)
        if spec is not None and spec.origin is not None:
            loader = _Loader(fullname, spec.origin)
            loader.keys = self.by_module[fullname]
            spec.loader = loader
        return spec


def install(keys: Iterable[str]) -> None:
    """From now on modules are imported with these constants ``listed``; keys are ``file.py::NAME``."""
    by_module: dict[str, dict[str, str]] = {}
    for key in keys:
        file, name = key.split("::")
        module = file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        if module in sys.modules:
            raise RuntimeError(f"{module} was imported before its constants could be listed")
        by_module.setdefault(module, {})[name] = key
    sys.meta_path.insert(0, _Finder(by_module))
    read_cells()


def read_cells() -> None:
    """Let Numba read the cell of a ``Number64`` or ``Number32`` where it would write its value."""
    constant = BaseContext.get_constant_generic

    def get_constant_generic(context: Any, builder: Any, kind: Any, value: Any) -> Any:
        if not isinstance(value, Number64 | Number32) or kind not in (types.float64, types.float32):
            return constant(context, builder, kind, value)  # type: ignore[no-untyped-call]
        double = ir.DoubleType()
        address = ctypes.addressof(_cells) + ctypes.sizeof(ctypes.c_double) * value.cell
        pointer = builder.inttoptr(ir.Constant(ir.IntType(64), address), double.as_pointer())
        cell = builder.load(pointer)
        # it does not change while a kernel runs: LLVM may take it out of loops
        cell.set_metadata("invariant.load", builder.module.add_metadata([]))
        return cell if kind == types.float64 else builder.fptrunc(cell, ir.FloatType())

    BaseContext.get_constant_generic = get_constant_generic  # type: ignore[method-assign]
