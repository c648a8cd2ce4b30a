"""The lists of mutants fit the product: each text stands once in its file, and the changed file is Python."""

import ast
from dataclasses import replace

import pytest

from tests.mutations.mutant import ROOT, read_mutants

MUTANTS = read_mutants()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda one: one.name)
def test_a_mutant_changes_its_file(mutant):
    text = (ROOT / mutant.file).read_text()
    assert ast.dump(ast.parse(mutant.applied(text))) != ast.dump(ast.parse(text))
    for test in mutant.tests:
        assert (ROOT / test.split("::")[0]).is_file(), test


def test_names_are_unique_over_all_lists():
    assert len({one.name for one in MUTANTS}) == len(MUTANTS) >= 60


def test_a_text_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="stands 0 times in"):
        replace(MUTANTS[0], old="no such text").applied("text")
