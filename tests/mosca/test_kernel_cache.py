"""Compiled kernels are kept until something changes that went into them, and no longer."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mosca.numba_support.cache import ROOT, sources

FAST = """
from mosca.numba_support.decorators import kernel
from mosca import numbers

@kernel
def f():
    return numbers.TWO
"""
PROGRAM = """
import sys
sys.path[:0] = [sys.argv[1]]
import mosca.fast as fast
from mosca.numba_support.cache import is_compiled
kept = is_compiled(fast.f)
print(kept, fast.f(), is_compiled(fast.f))
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A package with a kernel, a constant that it compiles in, and a file that has nothing to do with it."""
    package = tmp_path / "mosca"
    support = package / "numba_support"
    support.mkdir(parents=True)
    for name in ("__init__", "cache", "decorators", "front_end", "libraries"):
        text = (ROOT / "mosca" / "numba_support" / f"{name}.py").read_text(encoding="utf-8")
        (support / f"{name}.py").write_text(text, encoding="utf-8")
    (package / "__init__.py").write_text("")
    (package / "fast.py").write_text(FAST)
    (package / "numbers.py").write_text("from mosca.deep import (\n    ONE,\n    TWO,\n)\n")
    (package / "deep.py").write_text("ONE, TWO = 1, 2\n")
    (package / "prose.py").write_text("import mosca.fast\n")
    return tmp_path


def run(project: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(project)], capture_output=True, text=True, check=True, cwd=project
    )
    return done.stdout.split()


def test_a_kernel_is_kept_until_something_changes_that_it_has_compiled_in(project: Path) -> None:
    assert run(project) == ["False", "2", "True"]
    assert run(project) == ["True", "2", "True"]
    (project / "mosca" / "prose.py").write_text("import mosca.fast  # changed\n")
    assert run(project) == ["True", "2", "True"]
    # two imports away: Numba alone would answer with the old constant
    (project / "mosca" / "deep.py").write_text("ONE, TWO = 1, 22\n")
    assert run(project) == ["False", "22", "True"]


def test_an_update_that_removes_a_class_reads_nothing_of_what_was_kept(project: Path) -> None:
    """The index names classes of arguments: read with the old one gone, it could not be loaded."""
    pairs = project / "mosca" / "pairs.py"
    pairs.write_text("from typing import NamedTuple\nclass Pair(NamedTuple):\n    a: int\n")
    fast = project / "mosca" / "fast.py"
    fast.write_text(FAST + "from mosca.pairs import Pair\n@kernel\ndef g(p):\n    return p.a\ng(Pair(3))\n")
    assert run(project) == ["False", "2", "True"]
    pairs.write_text(pairs.read_text().replace("Pair", "Couple"))
    fast.write_text(fast.read_text().replace("Pair", "Couple"))
    assert run(project) == ["False", "2", "True"]


def test_a_kept_kernel_that_another_one_calls_still_has_code_of_its_own(project: Path) -> None:
    """It is loaded while the other is compiled."""
    assert run(project) == ["False", "2", "True"]
    other = project / "mosca" / "other.py"
    other.write_text(
        "from mosca.fast import f\nfrom mosca.numba_support.decorators import kernel\n"
        "@kernel\ndef g():\n    return f() + 1\n"
    )
    both = f"import sys; sys.path[:0] = [{str(project)!r}]; from mosca.other import g, f; print(g(), f())"
    done = subprocess.run([sys.executable, "-c", both], capture_output=True, text=True, check=True, cwd=project)
    assert done.stdout.split() == ["3", "2"]


def test_what_a_file_imports_is_followed_through_every_way_to_write_it(tmp_path: Path) -> None:
    package = tmp_path / "mosca"
    package.mkdir()
    for name, text in {
        "__init__": "",
        "a": "from mosca import b, c as other\nimport mosca.d\n",
        "b": "def f():\n    from mosca.e import (\n        X,\n    )\n",
        "c": "import numpy\n",
        "d": "",
        "e": "",
        "left_out": "",
    }.items():
        (package / f"{name}.py").write_text(text)
    assert [p.stem for p in sources(package / "a.py", tmp_path)] == ["__init__", *"abcde"]


def test_importing_the_package_changes_no_environment_and_imports_nothing_heavy() -> None:
    told = subprocess.run(
        [
            sys.executable,
            "-c",
            "import os; before = dict(os.environ); import sys, mosca;"
            "print('numba' in sys.modules, 'numpy' in sys.modules, dict(os.environ) == before)",
        ],
        capture_output=True, text=True, check=True, env=os.environ, cwd=ROOT,
    ).stdout  # fmt: skip
    assert told.split() == ["False", "False", "True"]
