"""Compiled functions: bare steps keep to their law, and no kernel can use another's copy of a step.

Bare steps (no reference counting) must not allocate or return arrays, nor call functions that return one. Numba
itself refuses a bare step that allocates an array. One that returned an array, or took one from a step that had
allocated it, would compile, and would free memory in use, or leak it.
"""

import ast
import importlib
import inspect
import pkgutil
import re
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.compiler import Flags
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target

import mosca
import twin
from mosca.data.arrays import Array
from mosca.numba_support import libraries
from mosca.numba_support.decorators import bare_step, callable_bare_step, kernel, step
from mosca.numba_support.front_end import QuickFlags


def everything() -> dict[str, Dispatcher]:
    """Return all compiled functions of the rooms that have any."""
    found = {}
    modules = [*pkgutil.walk_packages(mosca.__path__, "mosca."), *pkgutil.walk_packages(twin.__path__, "twin.")]
    for info in modules:
        for value in vars(importlib.import_module(info.name)).values():
            if isinstance(value, Dispatcher):
                found[f"{value.py_func.__module__}.{value.py_func.__name__}"] = value
    return found


def is_bare(function: Dispatcher) -> bool:
    return function.targetoptions.get("_nrt") is False


def returns_an_array(function: Dispatcher) -> bool:
    """Decide by the annotation; without one, by whether it allocates one or takes it from a step that may."""
    said = function.py_func.__annotations__.get("return")
    if said is not None or is_bare(function):
        return "Array" in str(said)
    names = set(function.py_func.__code__.co_names)
    others = [function.py_func.__globals__.get(name) for name in names - {function.py_func.__name__}]
    makes = names & {"empty", "zeros", "ones", "full", "array", "copy", "arange"}
    return bool(makes) or any(isinstance(f, Dispatcher) and returns_an_array(f) for f in others)


def holds_an_array(kind: Any) -> bool:
    """Decide for a class of named tuples by the annotations of its fields, and of theirs."""
    fields = getattr(kind, "__annotations__", {}) if isinstance(kind, type) and issubclass(kind, tuple) else {}
    around = vars(importlib.import_module(kind.__module__)) if fields else {}
    arrays = ("Array", str(Array))
    return any(str(said) in arrays or holds_an_array(around.get(str(said), said)) for said in fields.values())


def packs_an_array(function: Dispatcher) -> bool:
    """Decide whether any value that a function returns is a named tuple, made there, with an array in it."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(function.py_func))).body
    calls = [c for r in ast.walk(tree) if isinstance(r, ast.Return) for c in ast.walk(r) if isinstance(c, ast.Call)]
    names = [c.func.id for c in calls if isinstance(c.func, ast.Name)]
    return any(holds_an_array(function.py_func.__globals__.get(name)) for name in names)


FUNCTIONS = everything()
BARE = {name: f for name, f in FUNCTIONS.items() if is_bare(f)}


def test_there_are_bare_steps() -> None:
    assert len(BARE) > 150


@pytest.mark.parametrize("name", sorted(BARE))
def test_a_bare_step_neither_returns_arrays_nor_takes_any_from_steps_that_make_them(name: str) -> None:
    function = BARE[name]
    assert not returns_an_array(function)
    assert not packs_an_array(function)
    around = function.py_func.__globals__
    for called in function.py_func.__code__.co_names:
        other = around.get(called)
        if isinstance(other, Dispatcher) and not is_bare(other):
            assert not returns_an_array(other), f"{name} takes an array from {called}, which nobody gives back"


def wave(length: float) -> float:
    return np.sin(length) / length


def replaceable_functions(a_kernel: Callable[..., Any], a_step: Callable[..., Any]) -> list[str]:
    """Compile a kernel that calls a step, and return what another kernel's copies could replace (weak symbols)."""
    compiled_wave = a_step(wave)

    @a_kernel
    def waves(lengths: np.ndarray) -> float:
        total = 0.0
        for length in lengths:
            total += compiled_wave(length)
        return total

    assert waves(np.array([20.0, 30.0])) == pytest.approx(wave(20.0) + wave(30.0))
    (compiled,) = waves.overloads.values()
    here = list(compiled.library.get_defined_functions())
    # the engine looks functions up by name, internal ones too, which may be called in another way
    assert not [f.name for f in here if f.linkage.name == "internal" and f.name in ("NRT_incref", "NRT_decref")]
    return [f.name for f in here if f.linkage.name == "linkonce_odr"]


def test_a_kernel_s_copies_of_other_functions_are_its_own() -> None:
    assert not replaceable_functions(kernel, step)
    assert replaceable_functions(numba.njit, numba.njit)


def test_quick_flags_are_equal_where_flags_of_numba_are() -> None:
    usual = Flags()
    usual.nrt, usual.error_model = True, "numpy"
    quick = QuickFlags(usual)
    said = QuickFlags(quick)
    said.no_cfunc_wrapper = False  # its default, said
    for same in (quick, quick.copy(), said):
        assert isinstance(same, QuickFlags)
        assert same == usual == same
        assert hash(same) == hash(usual)
    for name, value in {"nrt": False, "error_model": "python", "no_cfunc_wrapper": True}.items():
        other = quick.copy()
        setattr(other, name, value)
        assert other != usual != other
        assert other != quick


def code_of_sums(dtype: type) -> list[str]:
    """Return LLVM's instructions of a kernel whose two steps differ in nothing but their flags."""

    def one(values: np.ndarray) -> float:
        return np.sum(values) + max(values[0], values[1])

    strict, quick = bare_step(one), bare_step(fastmath=True)(one)

    @callable_bare_step
    def sums(values: np.ndarray) -> float:
        return strict(values) - quick(values)

    sums(np.arange(7, dtype=dtype))
    (text,) = sums.inspect_llvm().values()
    # symbols hold the number of what was compiled so far
    return [re.sub(r"_ZN[\w.$]+", "step", line) for line in text.splitlines() if line.startswith("  ")]


@contextmanager
def nothing_remembered(*_contexts: object) -> Iterator[None]:
    yield


def test_what_is_remembered_changes_no_code(monkeypatch: pytest.MonkeyPatch) -> None:
    remembered = [code_of_sums(np.float32) for _again in range(2)]
    monkeypatch.setattr(libraries, "remembering", nothing_remembered)
    found_out = code_of_sums(np.float32)
    assert {"fast", "float"} <= {line.split("fadd ")[1].split()[0] for line in found_out if "fadd " in line}
    assert remembered == [found_out, found_out]


def test_contexts_of_numba_are_as_they_were() -> None:
    code_of_sums(np.float32)
    typing, target = cpu_target.typing_context, cpu_target.target_context
    assert "resolve_function_type" not in vars(typing)
    assert not {"load_additional_registries", "get_abi_sizeof"} & set(vars(target))
