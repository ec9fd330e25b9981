"""Automata and robustness of specifications against the semantics by definition."""

from __future__ import annotations

import itertools
import random

import numpy as np
import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.filters.specification import MOST_STATES, Specification, automaton_of, parsed
from tests.oracles.formulas import NAMES, random_text, satisfied

LONGEST = 5


def built(text: str, names: tuple[str, ...] = NAMES):
    specification = Specification(text, names)
    return specification, automaton_of(specification)


def words(atoms: tuple[str, ...], length: int) -> list[tuple[int, ...]]:
    return list(itertools.product(range(1 << len(atoms)), repeat=length))


def read(atoms: tuple[str, ...], label: int) -> dict[str, bool]:
    return {name: bool(label >> i & 1) for i, name in enumerate(atoms)}


def agree_on_all_short_words(text: str) -> bool:
    """Compare acceptance, verdicts and the sign of the robustness with the definition."""
    try:
        specification, automaton = built(text)
    except ConfigurationError:  # too many states, or windows within others
        return False
    formula, atoms = parsed(text, NAMES), specification.atoms
    known: dict[tuple[int, ...], list[int]] = {}
    for length in range(1, LONGEST + 1):
        every = words(atoms, length)
        labels = np.array(every).T
        ends = automaton.run(list(labels))
        inside = np.array([labels >> i & 1 for i in range(len(atoms))])
        sign = specification.robustness_of(np.where(inside, 1.0, -1.0).transpose(1, 0, 2))
        for word, end, robust in zip(every, ends, sign, strict=True):
            expected = satisfied(formula, [read(atoms, label) for label in word])
            assert automaton.accepting[end] == expected, (text, word)
            assert (robust > 0) == expected, (text, word)
            for begun in range(1, length + 1):
                known.setdefault(word[:begun], []).append(1 if expected else -1)
    for word, ends in known.items():
        if len(word) < LONGEST - 1:
            end = int(automaton.run(list(word)))
            settled = int(automaton.verdict(len(word) - 1, end))
            assert settled == 0 or set(ends) == {settled}, (text, word)
    return True


def test_random_formulas_mean_what_their_definition_says() -> None:
    draw, done = random.Random(0), 0
    for _ in range(260):
        done += agree_on_all_short_words(random_text(draw, 3))
    assert done > 150


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("always safe", 2),
        ("eventually goal", 2),
        ("always safe & eventually goal", 3),
        ("safe until goal", 3),
        ("eventually (safe then goal)", 3),
        ("eventually[0,3] goal", 2),
        ("always[1,3] safe & eventually[2,4] goal", 3),
        ("safe", 2),
        ("always (safe | eventually goal)", 2),
        ("safe then goal then !safe", 4),
        ("eventually[0,2] goal & eventually[4,6] !goal", 3),
        ("always eventually[0,2] goal", 4),
    ],
)  # fmt: skip
def test_sizes_are_minimal_and_words_are_judged_by_definition(text: str, size: int) -> None:
    assert agree_on_all_short_words(text)
    assert built(text)[1].size == size


def test_long_windows_need_tables_but_no_states() -> None:
    _, automaton = built("eventually[0,50] goal & always[10,60] safe")
    assert automaton.size == 3
    assert automaton.begins.tolist() == [0, 10, 50, 51, 60, 61]
    label = automaton.label([np.array([True, False]), np.array([False, True])])
    assert label.tolist() == [1, 2]  # safe alone, the goal alone
    state = automaton.run([label] * 10)
    assert automaton.verdict(9, state).tolist() == [0, 0]
    state = automaton.step(10, state, label)
    assert automaton.verdict(10, state).tolist() == [0, -1]
    for k in range(11, 51):
        state = automaton.step(k, state, label)
    assert automaton.verdict(50, state).tolist() == [-1, -1]


def test_envs_may_be_at_different_instants() -> None:
    _, automaton = built("eventually[2,3] goal")
    state = automaton.step(np.array([1, 2, 3, 4]), np.full(4, automaton.initial), np.full(4, 1))
    assert automaton.verdict(np.array([1, 2, 3, 4]), state).tolist() == [0, 1, 1, -1]


def test_too_many_states_are_refused() -> None:
    names = ("safe", "a", "b", "c")
    text = "eventually a & eventually b & eventually c"
    assert built(text, names)[1].size == MOST_STATES
    with pytest.raises(ConfigurationError, match="automaton of 9 states; at most 8"):
        built(f"{text} & always safe", names)
    with pytest.raises(ConfigurationError, match="names 7 sets; give at most 6"):
        built(" | ".join("abcdefg"), tuple("abcdefg"))


def test_the_longest_window_is_short_work() -> None:
    _, automaton = built("always[10,100000] (safe | eventually[0,2] goal)")
    assert automaton.begins.tolist() == [0, 10, 100_000, 100_001]
    assert automaton.size == 4


@pytest.mark.parametrize(
    "text",
    [
        "always safe & eventually goal",
        "safe until goal",
        "eventually (safe then goal)",
        "eventually[1,3] goal",
        "always[0,2] safe | eventually[2,4] goal",
        "safe & always (goal | safe)",
    ],
)
def test_verdicts_fall_as_soon_as_they_are_known(text: str) -> None:
    specification, automaton = built(text)
    formula, atoms = parsed(text, NAMES), specification.atoms
    outcomes: dict[tuple[int, ...], set[int]] = {}
    for length in range(1, LONGEST + 1):
        for word in words(atoms, length):
            held = satisfied(formula, [read(atoms, label) for label in word])
            for begun in range(1, length + 1):
                outcomes.setdefault(word[:begun], set()).add(1 if held else -1)
    for word, ends in outcomes.items():
        if len(word) < LONGEST:
            settled = int(automaton.verdict(len(word) - 1, automaton.run(list(word))))
            assert settled == (ends.pop() if len(ends) == 1 else 0), word
