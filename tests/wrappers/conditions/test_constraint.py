"""Learned terms of constraints in compiled programs: whose functions they are."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs.engine.slots import Data
from safe_envs.errors import NotCompilableError
from safe_envs.filters.conditions.base import terms_source
from safe_envs.filters.learning.models.network import Network
from safe_envs.filters.learning.models.residual import LearnedResidual
from tests.conftest import problem_of
from tests.wrappers.learned import Terms


class Undefined(LearnedResidual):
    """Computes otherwise than the class whose `source` it has."""

    def floats(self, x):
        return [math.nan for _ in x]


def residual(kind):
    states = sp.symbols("position speed", real=True)
    network = Network.unscaled([np.ones((2, 2))], [np.ones(2)], "tanh")
    return kind(states, states, 1, network, np.ones((3, 2)))


def test_terms_of_others_are_refused():
    stranger: Any = Terms(problem_of("safe_envs/StochasticDubins-v0").plant, 1, [sp.Integer(1)])
    for terms in (stranger, residual(Undefined)):
        with pytest.raises(NotCompilableError, match=f"{type(terms).__name__} have no compiled"):
            terms_source(terms, "terms", Data())
    assert (
        "def terms(x, data, work)" in terms_source(residual(LearnedResidual), "terms", Data()).text
    )
