"""Compiled kernels are kept as long as nothing changed that went into them, and no longer."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mosca.numba_support.cache import KEPT_DAYS, keep_kernels_fresh, kernel_sources, kernel_state

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    """A package with a kernel, a constant that it compiles in, and a file that has nothing to do with it."""
    room = tmp_path / "mosca"
    room.mkdir()
    (room / "__init__.py").write_text("")
    (room / "fast.py").write_text(
        "from numba import njit\nfrom mosca import numbers\n\n@njit\ndef f():\n    return numbers.TWO\n"
    )
    (room / "numbers.py").write_text("from mosca.deep import TWO\n")
    (room / "deep.py").write_text("TWO = 2\n")
    (room / "prose.py").write_text("import mosca.fast\n")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "matters"), [("fast", True), ("numbers", True), ("deep", True), ("prose", False)]
)
def test_a_change_matters_where_a_kernel_can_have_compiled_it_in(
    sources: Path, name: str, matters: bool
) -> None:
    before = kernel_state(sources)
    path = sources / "mosca" / f"{name}.py"
    path.write_text(path.read_text() + "# changed\n")
    assert (kernel_state(sources) != before) == matters


def test_each_compiled_function_of_the_product_is_in_the_state() -> None:
    """Whatever numba compiles, found by looking at every module and not by how its source is written."""
    known = set(kernel_sources(ROOT))
    missed = []
    for path in (p for room in ("mosca", "twin") for p in (ROOT / room).rglob("*.py")):
        if path.stem in ("__init__", "__main__", "warm"):
            continue
        module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
        for thing in vars(module).values():
            if type(thing).__name__ == "CPUDispatcher":
                file = Path(thing.py_func.__code__.co_filename)
                if file.is_file() and ROOT in file.parents and file not in known:
                    missed.append(f"{file}: {thing.__name__}")
    assert not missed


def test_the_folder_is_the_same_after_a_change_elsewhere(
    sources: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    chosen = []
    for name in ("", "prose", "deep"):
        if name:
            path = sources / "mosca" / f"{name}.py"
            path.write_text(path.read_text() + "# changed\n")
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
        keep_kernels_fresh(sources)
        chosen.append(os.environ["NUMBA_CACHE_DIR"])
    assert chosen[0] == chosen[1] != chosen[2]


def test_old_states_are_forgotten_but_not_young_ones_nor_the_present(
    sources: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    old, young = sources / ".kernels" / "0000aaaa", sources / ".kernels" / "0000bbbb"
    present = sources / ".kernels" / f"{kernel_state(sources):08x}"
    for folder in (old, young, present):
        folder.mkdir(parents=True)
        (folder / "f.nbi").touch()
    long_ago = old.stat().st_mtime - (KEPT_DAYS + 1) * 86400
    for folder in (old, present):
        os.utime(folder, (long_ago, long_ago))
    keep_kernels_fresh(sources)
    assert not old.exists()
    assert young.exists()
    assert present.exists()


def test_a_folder_of_the_users_own_is_left_alone(sources: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "mine")
    keep_kernels_fresh(sources)
    assert os.environ["NUMBA_CACHE_DIR"] == "mine"
    assert not (sources / ".kernels").exists()


def test_it_is_set_before_numba_comes() -> None:
    """numba reads the variable when it is imported: importing the package must set it, and not import numba."""
    clean = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    told = subprocess.run(
        [sys.executable, "-c", "import sys, os, mosca; print('numba' in sys.modules, os.environ['NUMBA_CACHE_DIR'])"],
        capture_output=True, text=True, check=True, env=clean, cwd=ROOT,
    ).stdout  # fmt: skip
    assert told.startswith("False")
    assert ".kernels" in told
