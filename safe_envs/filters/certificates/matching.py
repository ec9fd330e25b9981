"""Whether a certificate is of a given system and problem, in exact numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from fractions import Fraction
from typing import Any, NamedTuple

import sympy as sp

from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, SafeEnvsError, shortened
from safe_envs.filters.certificates.certificate import BarrierCertificate, Plant
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.registry import make_problem
from safe_envs.systems import CUSTOM_ID, ENV_IDS

PERIOD = 2 * sp.pi
"""Of an angle."""


def plant_of(
    problem: SafetyProblem, knowledge: str = "plant", policy: Sequence[sp.Expr] = ()
) -> Plant:
    """Return the system of a problem in exact numbers: .1 is 1/10, not the float next to it.

    An unbounded state in which everything repeats after a turn gets one turn as its workspace.

    Args:
        problem: of an env.
        knowledge: "plant" for the simulated system, "model" for what the designer believes.
        policy: u(x) of the states, if it is of one policy.

    Raises:
        ConfigurationError: a state is unbounded, and something does not repeat in it.
    """
    system = problem.plant if knowledge == "plant" else problem.model

    drift, barriers, law = (
        tuple(exact_in(system, e) for e in expressions)
        for expressions in (system.drift, (b.expression for b in problem.barriers), policy)
    )
    matrices = [
        tuple(tuple(exact_in(system, e) for e in line) for line in matrix.tolist())
        for matrix in (system.input_matrix, system.diffusion)
    ]
    used = (*drift, *barriers, *law, *(e for matrix in matrices for line in matrix for e in line))
    return Plant(
        states=system.states,
        workspace=tuple(_ends(state, used) for state in problem.states),
        inputs=system.inputs,
        bounds=tuple((_rational(low), _rational(high)) for low, high in problem.input_bounds),
        drift=drift,
        input_matrix=matrices[0],
        diffusion=matrices[1],
        barriers=barriers,
        policy=law,
    )


def exact_in(system: ControlAffineSDE, expression: Any) -> sp.Expr:
    """Return an expression in exact numbers and functions that the checkers know.

    Args:
        system: whose parameters it has.
        expression: of states and parameters.
    """
    found = system.exact(sp.sympify(expression))
    # A text of SymPy has 15 digits, and the number of the env 17.
    floats = {e: _rational(float(e)) for e in found.atoms(sp.Float)}
    found = found.xreplace(floats).replace(sp.tan, lambda x: sp.sin(x) / sp.cos(x))
    return found.replace(sp.sinh, lambda x: (sp.exp(x) - sp.exp(-x)) / 2).replace(
        sp.cosh, lambda x: (sp.exp(x) + sp.exp(-x)) / 2
    )


def _rational(value: float) -> sp.Expr:
    exact = Fraction(repr(float(value)))
    return sp.Integer(exact.numerator) / sp.Integer(exact.denominator)


def _ends(state: Variable, used: Sequence[sp.Expr]) -> tuple[sp.Expr, sp.Expr]:
    if math.isfinite(state.low) and math.isfinite(state.high):
        return _rational(state.low), _rational(state.high)
    x = state.symbol
    endless = math.isinf(state.low) and math.isinf(state.high)
    if endless and all(e.subs(x, x + PERIOD) == e for e in used):
        return -sp.pi, sp.pi
    raise ConfigurationError(
        f"the state {x} is unbounded and the system does not repeat in it, so that no box holds the"
        " set of a certificate; give the problem a workspace for it"
    )


def difference(plant: Plant, other: Plant) -> str:
    """Return the name of the first part in which two plants differ, but for the policy.

    Args:
        plant: of a certificate.
        other: to compare with.

    Returns:
        Empty if both are the same.
    """
    for part in fields(Plant):
        if part.name != "policy":
            first, second = (_flat(getattr(p, part.name)) for p in (plant, other))
            if len(first) != len(second) or not all(map(_same, first, second)):
                return part.name.replace("_", " ")
    return ""


def _flat(value: Any) -> list[Any]:
    return [e for part in value for e in _flat(part)] if isinstance(value, tuple) else [value]


def _same(first: Any, second: Any) -> bool:
    return first == second or bool(sp.expand(first - second) == 0)


class EnvDifference(NamedTuple):
    """Whether the system of a certificate is that of the env that it names.

    Attributes:
        word: same, differs or "not compared".
        text: which says so.
    """

    word: str
    text: str


def env_difference(certificate: BarrierCertificate) -> EnvDifference:
    """Compare the system of a certificate, which may be a stranger's, with that of its env.

    Args:
        certificate: with the id of an env and its options.

    Returns:
        What was found. Systems from outside are not compared: their files would be run.
    """
    env_id, options = certificate.env_id, certificate.options
    if not env_id or env_id not in ENV_IDS or env_id == CUSTOM_ID or "system" in options:
        told = "no env of this project: what is checked is of the system in the file"
        return EnvDifference("not compared", f"the file names {told}")
    try:
        problem = make_problem(env_id, **options)
        part = difference(certificate.plant, plant_of(problem))
        of_model = bool(part) and not difference(certificate.plant, plant_of(problem, "model"))
    except (SafeEnvsError, TypeError, ValueError) as error:
        told = f"differs: there is no such env or no such system of it ({shortened(error)})"
        return EnvDifference("differs", f"the system {told}")
    if not part:
        return EnvDifference("same", f"the system is exactly that of {env_id} with its options")
    own = f"the {part} differs from that of {env_id} with its options"
    return EnvDifference("differs", own + (", it is the model's" if of_model else ""))


def system_differences(plant: Plant, system: ControlAffineSDE) -> list[str]:
    """Return in what a system differs from that of a certificate, in words.

    Args:
        plant: of the certificate.
        system: with its parameters.
    """
    if (plant.states, plant.inputs) != (system.states, system.inputs):
        return [_symbols(plant, system)]
    drift, effect, sigma = (
        sp.Matrix(part).applyfunc(lambda e: exact_in(system, e))
        for part in (system.drift, system.input_matrix, system.diffusion)
    )
    # Noises with the same covariance are the same.
    known: Any = sp.Matrix(plant.diffusion)
    parts: Any = (
        ("the drift", plant.drift, drift),
        ("the effect of the inputs", sp.Matrix(plant.input_matrix), effect),
        ("the noise", known * known.T, sigma * sigma.T),
    )
    return [name for name, ours, theirs in parts if not _equal(list(ours), list(theirs))]


def problem_differences(plant: Plant, problem: SafetyProblem) -> list[str]:
    """Return in what a problem differs from that of a certificate, apart from its system.

    Args:
        plant: of the certificate.
        problem: with its states, inputs and barriers.

    Raises:
        ConfigurationError: No certificate can be of the problem; see `plant_of`.
    """
    if (plant.states, plant.inputs) != (problem.plant.states, problem.plant.inputs):
        return [_symbols(plant, problem.plant)]
    given = plant_of(problem)
    ranges = [
        *zip(plant.states, plant.workspace, given.workspace, strict=True),
        *zip(plant.inputs, plant.bounds, given.bounds, strict=True),
    ]
    differing = [
        f"the {'workspace' if symbol in plant.states else 'bounds'} of {symbol}"
        for symbol, ours, theirs in ranges
        if not _equal(ours, theirs)
    ]
    return differing + ["the barriers"] * (not _equal(plant.barriers, given.barriers))


def is_among(known: Sequence[sp.Expr], given: sp.Expr) -> bool:
    """Return whether an exact expression equals one of several.

    Args:
        known: the several.
        given: the one.
    """
    return any(_equal([each], [given]) for each in known)


def _symbols(plant: Plant, system: ControlAffineSDE) -> str:
    known, given = (", ".join(map(str, (*s.states, *s.inputs))) for s in (plant, system))
    return f"the states and inputs ({known} in place of {given})"


def _equal(known: Sequence[Any], given: Sequence[Any]) -> bool:
    return len(known) == len(given) and all(
        is_zero(a - b) for a, b in zip(known, given, strict=True)
    )
