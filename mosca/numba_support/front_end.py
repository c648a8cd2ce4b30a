"""Memory for results that Numba otherwise finds out again and again while it compiles.

For each operation in a function Numba tries its implementations, up to forty that fail, until one fits. For each
function it imports all modules that register implementations. For each array it builds an LLVM module to find the
size of an element. For each call that it types it compares all its flags by attribute. Here these results are
remembered: signatures and implementations are the same, and so is the code.

``resolve_function_type`` of a typing context, ``load_additional_registries``, ``install_registry`` and
``get_abi_sizeof`` of a target context are its methods to override; ``_lookup_global``, ``_impl_keys``,
``_registries`` and the flags' ``_values`` are private (0.61 to 0.68 have them). Numba's own methods are restored as
soon as a kernel is compiled. ``tests/test_compiled.py`` shows that it works.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import types
from numba.core.compiler import Flags
from numba.core.targetconfig import ConfigStack, TargetConfig


class QuickFlags(Flags):
    """Numba's compiler flags, compared by what was set; Numba compares all 25 by attribute for each call it types.

    They are equal where Numba's own flags are equal; all of those have one hash.
    """

    __slots__ = ()

    def values(self) -> dict[str, Any]:
        """Return all flags by their names."""
        return {**_DEFAULTS, **self._values}

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TargetConfig):
            return NotImplemented
        return self._values == other._values or self.values() == other.values()

    def __hash__(self) -> int:
        return _HASH


_DEFAULTS = {name: option.default for name, option in Flags.options.items()}
_HASH = hash(Flags())


class Remembered:
    """Results found in this process."""

    def __init__(self) -> None:
        self.signatures: dict[Any, tuple[Any, Any, Any]] = {}
        """By function, types of its arguments and flags: signature, key of the implementation, the function."""
        self.sizes: dict[Any, int] = {}
        """Sizes of LLVM types [bytes]."""
        self.knows_registries = False
        self.in_use = False


REMEMBERED = Remembered()


@contextmanager
def remembering(typing: Any, target: Any, found: Remembered = REMEMBERED) -> Iterator[None]:
    """Make a typing and a target context of Numba remember results while the block runs; blocks may be nested.

    The caller must hold Numba's compiler lock: one function is compiled at a time in a process.
    """
    if found.in_use:
        yield
        return
    quick = (
        (typing, "resolve_function_type", _resolving(typing, found)),
        (target, "load_additional_registries", _loading(target, found)),
        (target, "get_abi_sizeof", _sizing(target, found)),
    )
    found.in_use = True
    try:
        for context, name, method in quick:
            setattr(context, name, method)
        yield
    finally:
        for context, name, _method in quick:
            delattr(context, name)
        found.in_use = False


def _resolving(typing: Any, found: Remembered) -> Callable[..., Any]:
    resolve, signatures = typing.resolve_function_type, found.signatures

    def resolved(function: Any, arguments: Any, named: Any) -> Any:
        kind: Any = typing._lookup_global(function) or function
        if not isinstance(kind, types.Function):
            return resolve(function, arguments, named)
        flags = ConfigStack.top_or_none()
        own: Any = flags and QuickFlags(flags)  # type: ignore[no-untyped-call]
        key = id(kind), tuple(arguments), tuple(named.items()), own
        if key not in signatures:
            signature = resolve(function, arguments, named)
            if signature is not None:
                signatures[key] = signature, kind.get_impl_key(signature), kind
            return signature
        signature, implementation, typed = signatures[key]
        typed._impl_keys[signature.args] = implementation  # Numba lowers the one that was typed last
        return signature

    return resolved


def _loading(target: Any, found: Remembered) -> Callable[[], None]:
    load = target.load_additional_registries

    def loaded() -> None:
        if not found.knows_registries:
            load()
            found.knows_registries = True
        for registry in list(target._registries):
            target.install_registry(registry)

    return loaded


def _sizing(target: Any, found: Remembered) -> Callable[[Any], int]:
    size_of, sizes = target.get_abi_sizeof, found.sizes

    def size(kind: Any) -> int:
        if kind not in sizes:
            sizes[kind] = size_of(kind)
        return sizes[kind]

    return size
