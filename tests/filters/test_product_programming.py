"""The dynamic program over state and automaton, against all policies with memory on a chain."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.filters.specification import Automaton, Parsed, Specification, automaton_of, parsed
from tests.oracles.formulas import satisfied

STEPS = 4
SETS = {"safe": (1, 1, 0, 1), "G1": (0, 1, 0, 0), "G2": (1, 0, 0, 1)}
"""Which of the four states of the chain are in the set."""


def chain(seed: int) -> np.ndarray:
    """Return probabilities by action, state and next state."""
    weights = np.random.default_rng(seed).exponential(size=(2, 4, 4)) ** 2
    return weights / weights.sum(axis=2, keepdims=True)


def best_with_memory(
    kernel: np.ndarray, formula: Parsed, ended: set[int], path: tuple[int, ...]
) -> float:
    """Return the largest probability of satisfaction over all policies, after a path.

    A policy sees the whole path; satisfaction is by definition.
    """
    if len(path) == STEPS + 1 or path[-1] in ended:
        word = [{name: bool(inside[x]) for name, inside in SETS.items()} for x in path]
        return float(satisfied(formula, word))
    following = [best_with_memory(kernel, formula, ended, (*path, x)) for x in range(4)]
    return float((kernel[:, path[-1]] @ following).max())


def values_of_product(
    kernel: np.ndarray, automaton: Automaton, ended: set[int]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return V_0 of each start, and V_k by state of the chain and of the automaton."""
    labels = automaton.label([SETS[name] for name in automaton.atoms])
    accepted = np.broadcast_to(automaton.accepting.astype(float), (4, automaton.size))
    tables = [accepted]
    states = np.arange(automaton.size)
    for k in reversed(range(STEPS)):
        following = automaton.step(k + 1, states, labels[:, None])  # of x' and a
        onward = np.take_along_axis(tables[0], following, axis=1)
        values = (kernel @ onward).max(axis=0)
        values = np.where(np.isin(np.arange(4), list(ended))[:, None], accepted, values)
        tables.insert(0, values)
    begun = automaton.step(0, automaton.initial, labels)
    return tables[0][np.arange(4), begun], tables


@pytest.mark.parametrize("ended", [set(), {3}, {0, 2}])
@pytest.mark.parametrize(
    "text",
    [
        "always safe",
        "eventually G1",
        "always safe & eventually (G1 then G2)",
        "eventually (G1 then G2) & always !(G1 & G2)",
        "safe until G2 | eventually[3,4] G1",
        "eventually[1,2] G1 & always[2,3] safe",
        "always eventually[0,1] G2",
        "always (G1 | eventually G2) until !safe",
    ],
)
def test_product_is_best_over_all_policies_with_memory(text: str, ended: set[int]) -> None:
    automaton = automaton_of(Specification(text, SETS))
    formula = parsed(text, SETS)
    for seed in range(3):
        kernel = chain(seed)
        expected = [best_with_memory(kernel, formula, ended, (x,)) for x in range(4)]
        found, tables = values_of_product(kernel, automaton, ended)
        np.testing.assert_allclose(found, expected, rtol=1e-13)
        for k, table in enumerate(tables):
            verdict = automaton.verdict(k, np.arange(automaton.size))
            np.testing.assert_allclose(table[:, verdict == 1], 1.0, rtol=1e-13)
            assert (table[:, verdict == -1] == 0.0).all()


def test_a_policy_without_memory_can_miss_a_sequence() -> None:
    # From the fork 0 a sequence needs G1 = 1 first and G2 = 3 next: the same state, two actions.
    kernel = np.zeros((2, 4, 4))
    kernel[:, [1, 2, 3], [0, 2, 3]] = 1.0
    kernel[0, 0, 1] = kernel[1, 0, 3] = 1.0
    text = "eventually (G1 then (G2 & !F))"
    sets = {"G1": (0, 1, 0, 0), "G2": (0, 0, 0, 1), "F": (1, 0, 0, 0)}
    automaton = automaton_of(Specification(text, sets))
    labels = automaton.label([sets[name] for name in automaton.atoms])

    def reached(actions: tuple[int, ...]) -> bool:
        x, state = 0, automaton.step(0, automaton.initial, labels[0])
        for k, u in enumerate(actions, 1):
            x = int(kernel[u, x].argmax())
            state = automaton.step(k, state, labels[x])
        return bool(automaton.accepting[state])

    assert not reached((0, 0, 0, 0))
    assert not reached((1, 1, 1, 1))
    assert reached((0, 0, 1, 0))
