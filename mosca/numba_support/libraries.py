"""Linking of compiled functions: a kernel is optimised once, as a whole, with its own copies of all steps.

By default Numba optimises and emits machine code for each function, and again for its copy in each caller, under one
weak symbol: the copy that is loaded first is used for all. Copies of a ``fastmath`` function may round differently.
So results depended on whether kernels were compiled in this process or loaded from the cache, and in which order.
Here steps are only linked, and the copies in a kernel are internal to it, under names of their own. This also saves a
third of the time to compile (images to tracks, one core: 122 to 83 s). Less frequent garbage collection and the
results that ``mosca.numba_support.front_end`` remembers save more.

``pipeline_class`` is Numba's documented way to change how it compiles; ``finalize`` and ``_optimize_final_module`` of
its code libraries are private (0.61 to 0.68 have them).
``tests/test_compiled.py`` shows that it works.
"""

import gc
import hashlib
from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags

from mosca.numba_support.front_end import QuickFlags, remembering


class StepLibrary(JITCodeLibrary):
    """A step's code: linked with what it calls, neither optimised nor emitted, as only kernels run it."""

    def finalize(self) -> None:
        """Link in what the step calls."""
        self._raise_if_finalized()  # type: ignore[no-untyped-call]
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._final_module.verify()
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, as Numba does for a function that has no wrapper for Python."""
        return 0

    @property
    def codegen(self) -> Any:
        """The code generator without the environment, which only wrappers for Python use."""
        return _WithoutEnvironments(self._codegen)


class KernelLibrary(JITCodeLibrary):
    """A kernel's code, whose copies of other functions no other kernel can use or replace."""

    def _optimize_final_module(self) -> None:
        functions = [f for f in self._final_module.functions if not f.is_declaration]
        own = sorted(f.name for f in functions if f.linkage.name == "external")
        for function in functions:
            if function.linkage.name == "linkonce_odr":
                function.linkage = "internal"
        super()._optimize_final_module()  # type: ignore[no-untyped-call]
        # LLVM changes how internal functions are called, and the engine finds any function by its name
        suffix = hashlib.sha256("".join(own).encode()).hexdigest()[:16]
        for function in self._final_module.functions:
            if function.linkage.name == "internal":
                function.name = f"{function.name}.{suffix}"


class _WithoutEnvironments:
    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def set_env(self, env_name: str, env: Any) -> None:
        """Do nothing: no machine code holds the variable that would be set."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)


class StepCompiler(Compiler):
    """Numba's compiler, whose code goes into a ``StepLibrary``."""

    library_class: type[JITCodeLibrary] = StepLibrary

    def __init__(
        self, typing: Any, target: Any, library: Any, arguments: Any, result: Any, flags: Flags, locals_: Any
    ) -> None:
        if library is None:
            library = self.library_class(target.codegen(), self.library_class.__name__)
            library.enable_object_caching()
        super().__init__(typing, target, library, arguments, result, QuickFlags(flags), locals_)  # type: ignore[no-untyped-call]
        self._contexts = typing, target

    def compile_extra(self, func: Any) -> Any:
        """Compile with less frequent garbage collection: compiling makes a great many objects that live on."""
        thresholds = gc.get_threshold()
        gc.set_threshold(100_000, *thresholds[1:])
        try:
            with remembering(*self._contexts):
                return super().compile_extra(func)  # type: ignore[no-untyped-call]
        finally:
            gc.set_threshold(*thresholds)


class KernelCompiler(StepCompiler):
    """Numba's compiler, whose code goes into a ``KernelLibrary``."""

    library_class = KernelLibrary
