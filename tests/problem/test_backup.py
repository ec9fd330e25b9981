"""A backup is checked where it is stated, and follows the numbers of its problem."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, SystemDefinitionError, define_problem
from safe_envs.problem.backup import Backup, BackupLaw, backup_of

x, v, u, k = sp.symbols("x v u k", real=True)
SYSTEM = ControlAffineSDE((x, v), (u,), [v, 0], [0, 1], [[0], [0]], {k: 2.0})
BRAKE = BackupLaw("brake", (-k * v,), terminal=1 - x)


def problem(backup, **rest):
    given = {"input_bounds": (-1.0, 1.0), "start": [0.0, 0.0], "dt": 0.1, "horizon": 1.0, **rest}
    return define_problem(SYSTEM, 1 - x, backup=backup, **given)


def by_period(stated):
    return Backup((replace(BRAKE, terminal=1 - x - stated.dt * sp.Max(v, 0)),), 10 * stated.dt)


def test_a_problem_has_no_backup_unless_it_states_one():
    assert backup_of(problem(None)) is None
    assert backup_of(problem(Backup((BRAKE,), 1.0))) == Backup((BRAKE,), 1.0)


def test_a_function_follows_the_numbers_of_the_problem():
    sent = pickle.loads(pickle.dumps(problem(by_period)))
    assert backup_of(sent) == backup_of(problem(by_period))
    changed = sent.configured(dt=0.05, plant={"k": 3.0}, input_bounds=(-2.0, 2.0))
    found = backup_of(changed)
    assert found is not None
    assert found.horizon == 0.5
    assert found.laws[0].terminal == 1 - x - 0.05 * sp.Max(v, 0)
    assert changed.plant.numeric(found.laws[0].law[0]) == -3 * v


def test_limited_rates_leave_the_backup_out():
    limited = problem(Backup((BRAKE,), 1.0)).configured(rate_limit=(-1.0, 1.0))
    assert backup_of(limited) is None


@pytest.mark.parametrize(
    ("make", "fragment"),
    [
        (lambda: BackupLaw("a", (u,)), "terminal set"),
        (lambda: BackupLaw("a", (u,), x, {x: 0}), "terminal set"),
        (lambda: BackupLaw("", (u,), x), "name of a backup law"),
        (lambda: BackupLaw("a", -v, x), "expression for each input"),
        (lambda: BackupLaw("a", ("-v",), x), "is a text"),
        (lambda: BackupLaw("a", (-v,), "x"), "is a text"),
        (lambda: Backup((), 1.0), "`BackupLaw`"),
        (lambda: Backup((BRAKE, BRAKE), 1.0), "another name"),
        (lambda: problem(BRAKE), "`Backup`"),
        (lambda: problem(Backup((BackupLaw("a", (-v, v), x),), 1.0)), "2 expressions"),
        (lambda: problem(Backup((BackupLaw("a", (-u,), x),), 1.0)), "symbol u"),
        (lambda: problem(Backup((BackupLaw("a", (-v,), u),), 1.0)), "symbol u"),
        (lambda: problem(Backup((BackupLaw("a", (-v,), None, {u: 0}),), 1.0)), "symbol u"),
        (lambda: problem(Backup((BackupLaw("a", (-v,), None, {x: v}),), 1.0)), "symbol v"),
        (lambda: backup_of(problem(lambda stated: BRAKE)), "`Backup`"),
        *((lambda h=h: Backup((BRAKE,), h), "horizon") for h in (0, -1.0, math.inf, math.nan)),
        (lambda: Backup((BRAKE,), "soon"), "horizon"),
    ],
)
def test_mistakes_are_named(make, fragment):
    with pytest.raises((SystemDefinitionError, ConfigurationError), match=fragment):
        make()
