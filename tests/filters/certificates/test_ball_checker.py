"""The second opinion agrees with the checker."""

from __future__ import annotations

import sys

import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.balls import check_with_balls
from tests.filters.certificates.examples import FALSE, TRUE, UNDECIDED


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "flint", None)
    with pytest.raises(ConfigurationError, match=r'editable "\.\[proofs\]"'):
        check_with_balls(TRUE["a line"])


@pytest.mark.parametrize(
    ("name", "word"),
    [
        *((name, "checked") for name in TRUE),
        *((name, "refuted") for name in FALSE),
        *((name, "undecided") for name in UNDECIDED),
    ],
)
def test_both_agree(name, word):
    flint = pytest.importorskip("flint")
    before = flint.ctx.prec
    certificate = (TRUE | FALSE | UNDECIDED)[name]
    boxes = 400 if word == "undecided" else 3000
    assert check_with_balls(certificate, boxes=boxes).word == word
    assert flint.ctx.prec == before
