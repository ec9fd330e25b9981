"""Policies that need no training: nominal controller, no action, random actions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.agents.policies.actions_kernel import (
    action_of_input,
    random_action,
)
from safe_envs.agents.policies.base import CHOOSE, StatelessPolicy
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.noise import POLICY, EpisodeUniforms, episode_seeds
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.slots import Data
from safe_envs.envs.spaces import center_and_half_width, observation_names
from safe_envs.errors import ConfigurationError, NumericalError
from safe_envs.filters.decision_source import filter_source
from safe_envs.filters.decisions import FilterQPSolver
from safe_envs.filters.qp import FilterQP, UndefinedConstraintError
from safe_envs.problem.clf import CLF
from safe_envs.problem.measurement import require_full_state
from safe_envs.problem.problem import SafetyProblem


class NominalController(StatelessPolicy):
    """The problem's nominal controller.

    It sees the observation and the model's parameters, never the plant.

    Args:
        problem: whose `nominal` laws, input bounds and features are taken.

    Raises:
        ConfigurationError: The problem is measured.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        require_full_state(problem, "nominal controllers")
        super().__init__(len(problem.features))
        self._name = problem.name
        self._box = problem.input_bounds
        self._center, self._half = center_and_half_width(problem)
        self._symbols = tuple(f.symbol for f in problem.features)
        self._laws = tuple(problem.model.numeric(law) for law in problem.nominal)
        self._floats = compile_function(self._symbols, self._laws, "floats")
        self._arrays = compile_function(self._symbols, self._laws, "arrays")

    def actions(self, given: np.ndarray) -> np.ndarray:
        """Evaluate the laws; see `StatelessPolicy.actions`.

        Raises:
            NumericalError: A law has no finite value at an observation.
        """
        if given.ndim == 1:
            try:
                inputs = self._floats(*given.tolist())
            except (OverflowError, ZeroDivisionError, ValueError) as error:
                raise self._undefined(given) from error
        else:
            with np.errstate(all="ignore"):
                inputs = self._arrays(*np.ascontiguousarray(given.T))
        actions = np.empty((*given.shape[:-1], len(self._box)))
        for j, (u, (low, high), c, w) in enumerate(
            zip(inputs, self._box, self._center, self._half, strict=True)
        ):
            actions[..., j] = (np.minimum(np.maximum(u, low), high) - c) / w
        if not np.isfinite(actions).all():
            rows = given.reshape(-1, self._width)
            raise self._undefined(rows[~np.isfinite(actions.reshape(len(rows), -1)).all(axis=1)][0])
        return actions

    def source(self, data: Data) -> Source:
        """See `Policy.source`."""
        entries = ""
        for j, ((low, high), c, w) in enumerate(
            zip(self._box, self._center, self._half, strict=True)
        ):
            place = data.add([low, high, c, w])
            numbers = ", ".join(f"data[{place + i}]" for i in range(4))
            entries += f"action_of_input(inputs[{j}], {numbers}), "
        return formulas("nominal_laws", {"observation": self._symbols}, self._laws, data) + Source(
            f"{CHOOSE}    inputs = nominal_laws(observation, data)\n    return ({entries})\n",
            (action_of_input,),
        )

    def _undefined(self, observation: np.ndarray) -> NumericalError:
        return NumericalError(
            f"the nominal controller of {self._name!r} has no finite value at the observation"
            f" {observation.tolist()}"
        )


class ZeroController(StatelessPolicy):
    """The physical input 0, or the point within the input bounds nearest to it.

    Args:
        problem: whose input bounds are taken.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        super().__init__(len(observation_names(problem)))
        center, half = center_and_half_width(problem)
        inputs = [min(max(0.0, low), high) for low, high in problem.input_bounds]
        self._action = np.array([(u - c) / w for u, c, w in zip(inputs, center, half, strict=True)])

    def actions(self, given: np.ndarray) -> np.ndarray:
        """Return the one action for every observation; see `StatelessPolicy.actions`."""
        return np.tile(self._action, (*given.shape[:-1], 1))

    def source(self, data: Data) -> Source:
        """See `Policy.source`."""
        place = data.add(self._action)
        entries = "".join(f"data[{place + j}], " for j in range(len(self._action)))
        return Source(f"{CHOOSE}    return ({entries})\n")


class RandomPolicy(StatelessPolicy):
    """Independent actions, uniform in [-1, 1].

    In an evaluation every episode has a stream of its own, so that its actions do not depend on the
    batch that it is simulated in; elsewhere one generator serves all calls.

    Args:
        problem: whose number of inputs is taken.
        seed: of the generator that serves outside evaluations.
    """

    deterministic = False

    def __init__(self, problem: SafetyProblem, seed: int = 0) -> None:
        super().__init__(len(observation_names(problem)))
        self._m = len(problem.inputs)
        self._generator = np.random.default_rng(seed)
        self._uniforms: EpisodeUniforms | None = None

    def begin(self, episodes: range, seed: int) -> None:
        """Give each episode its stream; see `Policy.begin`."""
        self._uniforms = EpisodeUniforms(episode_seeds(seed, episodes), POLICY, self._m)

    def resume(self, rows: range, seeds: Sequence[int], periods: Sequence[int]) -> None:
        """Go on in each episode's stream; see `Policy.resume`."""
        self._uniforms = EpisodeUniforms(seeds, POLICY, self._m, periods)

    def actions(self, given: np.ndarray) -> np.ndarray:
        """Draw actions; see `StatelessPolicy.actions`."""
        batch = given.shape[:-1]
        if self._uniforms is None or batch != (len(self._uniforms),):
            return self._generator.uniform(-1.0, 1.0, (*batch, self._m))
        return 2.0 * self._uniforms.next() - 1.0

    def source(self, data: Data) -> Source:
        """See `Policy.source`."""
        m = self._m
        entries = "".join(f"random_action(step * {m} + {j}, k0, k1), " for j in range(m))
        return Source(f"{CHOOSE}    return ({entries})\n", (random_action,))


class CLFController(StatelessPolicy):
    """Minimizes w_u |u|^2 + w_d d^2 subject to AV + rate V <= d and the input bounds, exactly.

    It is the joint QP of `safe_envs.wrappers.SafetyFilter` without barriers: put a filter with
    `objective="clf"` over `ZeroController` for the one with them. With a single input there is no
    difference between that and a filter over this controller, since the cost is convex; with
    several there is, since the nearest action is not the cheapest one.

    Args:
        problem: whose model, input bounds and features are taken.
        clf: the goal; that of the problem by default.

    Raises:
        ConfigurationError: the problem is measured, there is no goal, or the observation does not
            hold the states.

    Source: the CLF part of the quadratic programs in thesis Sec. 4.3.1 and 5.4.2.
    """

    def __init__(self, problem: SafetyProblem, clf: CLF | None = None) -> None:
        require_full_state(problem, "CLF controllers")
        goal = clf or problem.clf
        if goal is None:
            raise ConfigurationError(
                f"{problem.name} has no control Lyapunov function; use the policy nominal, or"
                " give one"
            )
        super().__init__(len(problem.features))
        self._name = problem.name
        self._columns = _columns_of_states(problem)
        self._center, self._half = center_and_half_width(problem)
        low, high = (
            [pair[0] for pair in problem.input_bounds],
            [pair[1] for pair in problem.input_bounds],
        )
        qp = FilterQP(problem.model, (), low, high, [1.0] * problem.model.m, [], problem.dt, goal)
        self._qp, self._qp_solver = qp, FilterQPSolver(qp)

    def actions(self, given: np.ndarray) -> np.ndarray:
        """Solve the QP; see `StatelessPolicy.actions`.

        Raises:
            NumericalError: The goal has no finite value at an observation.
        """
        x = np.ascontiguousarray(given[..., self._columns].T)
        try:
            if given.ndim == 1:
                found = self._qp_solver.floats(tuple(x.tolist()), [0.0] * len(self._half))
            else:
                nothing = (np.zeros(len(given)),) * len(self._half)
                found = self._qp_solver.arrays(tuple(x), nothing)
            inputs = found.proposed
        except (ArithmeticError, ValueError) as error:
            row = (
                given[error.index]
                if given.ndim == 2 and isinstance(error, UndefinedConstraintError)
                else given
            )
            raise NumericalError(
                f"the goal of {self._name!r} has no finite value at the observation {row.tolist()}"
            ) from error
        return np.stack(
            [(u - c) / w for u, c, w in zip(inputs, self._center, self._half, strict=True)], axis=-1
        )

    def source(self, data: Data) -> Source:
        """See `Policy.source`."""
        scales, m = data.add([*self._center, *self._half]), len(self._half)
        x = "".join(f"observation[{column}], " for column in self._columns)
        inputs = enumerate(f"data[{scales + j}]) / data[{scales + m + j}]" for j in range(m))
        entries = "".join(f"(best[1][{j}] - {scaled}, " for j, scaled in inputs)
        return filter_source(self._qp, data, "pursue_goal") + Source(
            f"{CHOOSE}    best = pursue_goal(({x}), ({'0.0, ' * m}), data, work)\n"
            f"    if not best[6]:\n        return ({'nan, ' * m})\n    return ({entries})\n"
        )


def _columns_of_states(problem: SafetyProblem) -> list[int]:
    expressions = [feature.expression for feature in problem.features]
    hidden = [str(state) for state in problem.model.states if state not in expressions]
    if hidden:
        raise ConfigurationError(
            f"the observation of {problem.name} does not hold {', '.join(hidden)}, which a CLF"
            " controller needs"
        )
    return [expressions.index(state) for state in problem.model.states]
