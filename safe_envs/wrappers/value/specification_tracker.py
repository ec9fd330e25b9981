"""A specification along the traces of a batch of episodes."""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.envs.info import Info, specification_info
from safe_envs.problem.named_sets import NamedSets, set_names
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.automaton_building import automaton_of
from safe_envs.wrappers.value.specification import Specification


class SpecificationTracker:
    """Follows the automaton and the robustness of a specification, episode by episode.

    Attributes:
        specification: over the problem's sets.
        automaton: of it.
        steps: control periods of each episode so far, (B,).
        states: of the automaton, (B,).
        registers: of the specification, (size, B).

    Args:
        problem: whose sets the specification names.
        text: of the specification.
        count: B, the number of episodes.

    Raises:
        ConfigurationError: The text is no specification over the problem's sets, needs too many
            states, or has a window that ends after the episode.
    """

    def __init__(self, problem: SafetyProblem, text: str, count: int) -> None:
        self.specification = Specification(text, set_names(problem))
        self.specification.require_horizon(problem.steps)
        self.automaton = automaton_of(self.specification)
        self._sets = NamedSets(problem, self.specification.atoms)
        self._bits = 1 << np.arange(len(self.specification.atoms))
        self.steps = np.zeros(count, dtype=np.int64)
        self.states = np.full(count, self.automaton.initial)
        self.registers = np.zeros((self.specification.size, count))

    def begin(self, x: Components, envs: np.ndarray) -> None:
        """Begin traces.

        Args:
            x: components of all states, each (B,).
            envs: which traces begin, bool (B,).

        Raises:
            NumericalError: A set has no value there.
        """
        values = self._sets.values(tuple([component[envs] for component in x]))
        self.steps[envs] = 0
        self.states[envs] = self.automaton.step(0, self.automaton.initial, self._labels(values))
        self.registers[:, envs] = self.specification.start(values)

    def advance(self, x: Components) -> None:
        """Append a state to each trace.

        Args:
            x: components of the states, each (B,).

        Raises:
            NumericalError: A set has no value there.
        """
        values = self._sets.values(x)
        self.steps = k = self.steps + 1
        self.states = self.automaton.step(k, self.states, self._labels(values))
        self.registers = self.specification.advance(k, self.registers, values)

    def report(self) -> Info:
        """Return what `info` says of the traces so far, fresh arrays (B,)."""
        return specification_info(
            robustness=self.specification.robustness(self.registers).copy(),
            satisfied=self.automaton.accepting[self.states],
            verdict=self.automaton.verdict(self.steps, self.states),
            automaton_state=self.states.copy(),
        )

    def _labels(self, values: np.ndarray) -> np.ndarray:
        return self._bits @ self._sets.inside(values)
