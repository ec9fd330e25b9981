"""The list of mutants fits the code: `make mutants` applies them, which takes minutes."""

from __future__ import annotations

import pytest

from tests.mutants.run import ROOT, Mutant, mutants


@pytest.mark.parametrize("mutant", mutants(), ids=lambda mutant: mutant.name)
def test_a_mutant_can_be_applied(mutant: Mutant):
    assert mutant.old != mutant.new
    assert (ROOT / mutant.file).read_text().count(mutant.old) == 1
    assert mutant.tests
    assert all((ROOT / path).is_file() for path in mutant.tests)


def test_names_are_unique():
    names = [mutant.name for mutant in mutants()]
    assert len(set(names)) == len(names)
