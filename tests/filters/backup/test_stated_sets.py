"""Terminal sets that are stated: what samples show of them is refused, with a state."""

from __future__ import annotations

import re

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, SystemDefinitionError
from safe_envs.problem.backup import BackupLaw
from safe_envs.proofs.backup_filter import BackupFilter
from safe_envs.proofs.backup_plans import sampled_states
from tests.oracles.carts import BRAKE, PULL, STRONGEST, cart_problem, v, x


def made(law, terminal, **options):
    stated = BackupLaw("said", (sp.sympify(law),), terminal=terminal)
    return BackupFilter.for_problem(cart_problem(laws=(stated,), **options))


@pytest.mark.parametrize(
    ("law", "terminal", "said"),
    [
        (-STRONGEST, 1 - x, "leaves it"),
        (-STRONGEST, 10 - x - v, "unsafe state"),
        (0, 1 - x - sp.Max(v, 0) ** 2, "leaves it"),
        # What full braking keeps in continuous control, with a third of the way too little.
        (-STRONGEST, 1 - x - sp.Max(v, 0) ** 2 / (3 * STRONGEST), "leaves it"),
        (-STRONGEST, sp.Float(0.2) - (x - 0.5) ** 2 - v**2, "leaves it"),
        (-STRONGEST - sp.sqrt(x + 0.2), sp.Min(-v, 1 - x), "no finite input"),
    ],
)
def test_a_set_that_is_not_kept_is_refused(law, terminal, said):
    with pytest.raises(SystemDefinitionError, match=said) as error:
        made(law, terminal)
    names = dict(re.findall(r"(\w+) = (-?[\d.e-]+),", str(error.value)))
    at = {x: float(names["x"]), v: float(names["v"])}
    assert float(terminal.subs(at)) >= -1e-5


@pytest.mark.parametrize("terminal", [-v, sp.Min(-v, 1 - x), sp.Integer(-1), -v - 1000])
def test_a_set_whose_safe_part_is_kept_is_taken(terminal):
    assert made(-STRONGEST, terminal).stated == ("said",)


def test_each_law_is_looked_at():
    with pytest.raises(SystemDefinitionError, match="backup law wrong: at x = "):
        BackupFilter.for_problem(
            cart_problem(laws=(BRAKE, BackupLaw("wrong", (sp.Integer(1),), terminal=1 - x - v)))
        )
    with pytest.raises(SystemDefinitionError, match="backup law brake: at"):
        BackupFilter.for_problem(cart_problem(laws=(BRAKE, PULL), barriers=(1 - x, x + 1)))


def test_with_noise_only_the_numbers_of_the_law_are_looked_at():
    assert made(0, 1 - x, noise=0.1).stated == ("said",)
    with pytest.raises(SystemDefinitionError, match="no finite input"):
        made(sp.log(x), 1 - x, noise=0.1)


def test_samples_cover_starts_and_what_is_around_them():
    problem = cart_problem()
    states = sampled_states(problem)
    assert np.isfinite(states).all()
    starts = problem.starts[problem.start].proposals(10)
    assert (states.min(axis=0) <= starts.min(axis=0)).all()
    assert (states.max(axis=0) >= starts.max(axis=0)).all()
    assert (sampled_states(problem) == states).all()


def test_a_margin_beyond_the_set_is_refused():
    problem = cart_problem(laws=(BackupLaw("said", (-STRONGEST,), sp.Min(-v, 1 - x, x + 3)),))
    with pytest.raises(SystemDefinitionError, match="leaves it"):
        BackupFilter.for_problem(problem, "backup:margin=0.1")
    with pytest.raises(ConfigurationError, match=r"margin = 1000 .* smallest barrier is"):
        BackupFilter.for_problem(cart_problem(), "backup:margin=1000")


def test_a_function_of_a_backup_that_fails_is_told():
    problem = cart_problem(backup=lambda problem: problem.missing)
    with pytest.raises(SystemDefinitionError, match="failed: AttributeError"):
        BackupFilter.for_problem(problem)
