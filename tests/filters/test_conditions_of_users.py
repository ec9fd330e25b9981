"""Conditions from outside: of a file, of a module, and of an installed package."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from safe_envs import plugins
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.dynamics.lie import lie_derivative_f
from safe_envs.errors import ConfigurationError
from safe_envs.filters.conditions.syntax import files_of, learned_parts, with_absolute_paths
from safe_envs.scripts.options import completion
from safe_envs.wrappers import (
    CBF,
    AffineConstraint,
    Condition,
    SafetyFilter,
    condition_names,
    parse_condition,
    parse_conditions,
    require_readable,
    spec_of,
)
from tests.conftest import problem_of

SCALAR = problem_of("safe_envs/Scalar-v0")
DISK = problem_of("safe_envs/DubinsDisk-v0")

STATED = """
from dataclasses import dataclass

from safe_envs.dynamics.lie import lie_derivative_f
from safe_envs.wrappers import CBF, AffineConstraint, Condition


@dataclass(frozen=True)
class Eager(Condition):
    gain: float = 1.0
    powers: tuple[float, ...] = (1.0,)
    order: int = 1
    strict: bool = False
    note: str | None = None

    def derived(self, model, barrier):
        h = barrier.expression
        total = sum(self.gain * h ** int(power) for power in self.powers)
        return AffineConstraint.after(model, (h,), lie_derivative_f(model, h) + total)


@dataclass(frozen=True)
class Picky(Eager):
    def __post_init__(self):
        range(self.order)
        if self.gain > 9:
            raise ValueError("too eager")


@dataclass(frozen=True)
class Alike(CBF):
    pass


class Undecorated(Eager):
    other: float = 1.0


@dataclass(frozen=True)
class Unfinished(Condition):
    pass


@dataclass(frozen=True)
class Failing(Condition):
    def derived(self, model, barrier):
        return barrier.nothing


@dataclass(frozen=True)
class Wordy(Condition):
    def derived(self, model, barrier):
        return "a u + b >= 0"


@dataclass(frozen=True)
class Short(Condition):
    def derived(self, model, barrier):
        return AffineConstraint((), 1, (barrier.expression,))


@dataclass(frozen=True)
class Constant(Condition):
    def derived(self, model, barrier):
        return AffineConstraint((1,) * model.m, 0, (barrier.expression,))


instance = Eager()
"""


@pytest.fixture
def stated(tmp_path, monkeypatch):
    """A folder with a file of conditions, where the tests then are."""
    (tmp_path / "my_filter.py").write_text(STATED)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def installed(stated, monkeypatch):
    """The same file as a module of an installed package that declares one condition."""
    (stated / "my_package.py").write_text(STATED)
    meta = stated / "my_package-1.0.dist-info"
    meta.mkdir()
    (meta / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    (meta / "entry_points.txt").write_text("[safe_envs.conditions]\neager = my_package:Eager\n")
    monkeypatch.syspath_prepend(str(stated))
    yield stated
    sys.modules.pop("my_package", None)


def test_a_condition_of_a_file_filters_as_the_one_that_it_states(stated):
    (condition,) = parse_conditions("my_filter.py:Eager:gain=2", SCALAR)
    x, u = np.array([[0.2], [0.9]]), np.array([[1.0], [1.0]])
    one, other = (SafetyFilter.for_problem(SCALAR, c) for c in (condition, CBF(2.0)))
    assert np.array_equal(one.filter(x, u).action, other.filter(x, u).action)


@pytest.mark.parametrize(
    "text",
    [
        "my_filter.py:Eager",
        "my_filter.py:Eager:gain=2.5:powers=1,3:order=2:strict=True:note=fast",
        "./my_filter.py:Picky:powers=3:sampling_margin=0.25",
        "my_filter.py:Alike:alpha=s+s**3",
    ],
)
def test_text_round_trips(stated, text):
    condition = parse_condition(text, (1.0,))
    assert parse_condition(spec_of(condition), ()) == condition
    assert spec_of(parse_condition(spec_of(condition), ())) == spec_of(condition)
    assert spec_of(condition).startswith(f"{stated.resolve()}/my_filter.py:")


def test_parameters_are_of_the_types_of_their_defaults(stated):
    found = parse_condition("my_filter.py:Eager:order=2:strict=False:powers=3:note=fast", ())
    assert repr(found.parameters) == (
        "{'gain': 1.0, 'powers': (3.0,), 'order': 2, 'strict': False, 'note': 'fast'}"
    )


def test_several_barriers_take_conditions_of_files_as_well(tmp_path, monkeypatch):
    folder = tmp_path / "c++, folder"
    folder.mkdir()
    (folder / "my_filter.py").write_text(STATED)
    monkeypatch.chdir(folder)
    limits = problem_of("safe_envs/QuadrotorLimits-v0")
    for text in (
        "my_filter.py:Alike:alpha=s+s**3+hocbf:alpha=1,2+my_filter.py:Eager",
        f"hocbf+{folder}/my_filter.py:Alike+{folder}/my_filter.py:Eager:powers=1,3",
    ):
        conditions = parse_conditions(text, limits)
        assert sorted(c.name for c in conditions) == ["Alike", "Eager", "hocbf"]
        assert parse_conditions(spec_of(conditions), limits) == conditions


def test_the_files_of_a_text_are_known_without_running_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = "my_filter.py:Eager:gain=2+ddscbf:file=gap.json+scbf"
    assert files_of(text) == (Path("my_filter.py"), Path("gap.json"))
    assert files_of(with_absolute_paths(text)) == tuple(
        (tmp_path / name).resolve() for name in ("my_filter.py", "gap.json")
    )
    assert learned_parts("ddscbf:file=gap.json") == [("ddscbf", "gap.json")]


def test_an_installed_condition_is_known_by_its_name(installed):
    assert "eager" in condition_names()
    assert completion.filters("ea") == ["eager"]
    (condition,) = parse_conditions("eager:gain=2", SCALAR)
    assert spec_of(condition).startswith("eager:gain=2.0:")
    assert parse_conditions(spec_of(condition), SCALAR) == (condition,)
    with pytest.raises(ConfigurationError, match="did you mean 'eager'"):
        require_readable("eagr", SCALAR)


def test_an_installed_condition_cannot_take_the_name_of_the_unfiltered_env(monkeypatch):
    monkeypatch.setattr(plugins, "plugin_names", lambda group: ("eager", "none", "scbf"))
    names = condition_names()
    assert "none" not in names
    assert (names.count("scbf"), names.count("eager")) == (1, 1)


def test_a_condition_of_a_module_is_known_by_its_place(installed):
    condition = parse_condition("my_package:Picky:gain=2", ())
    assert spec_of(condition).startswith("my_package:Picky:gain=2.0")
    assert parse_condition(spec_of(condition), ()) == condition


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("my_filter.py:Eagr", "Eagr"),
        ("my_filter.py:Eager:gian=2", "gian"),
        ("my_filter.py:Eager:gain=1,2", "gain"),
        ("my_filter.py:Eager:gain=1:gain=2", "gain.*twice"),
        ("my_filter.py:Eager:file=x", "file"),
        ("my_filter.py:Picky:gain=10", "too eager"),
        ("my_filter.py:Picky:order=few", "order"),
        ("my_filter.py:Eager:gain=nan", "gain"),
        ("my_filter.py:Undecorated", "dataclass"),
        ("my_filter.py:Unfinished", "derived"),
        ("my_filter.py:instance", "Eager.*Condition"),
        ("nowhere.py:Eager", "nowhere.py"),
        ("json:dumps", "function"),
        ("my_filtr:Eager", "my_filtr"),
        ("my_filter.py:Eager+scbf", "2 conditions"),
        ("my_filter.py:Eager,none", "Eager,none"),
        # Code that fails is an error of its condition.
        ("my_filter.py:Failing", "Failing"),
        ("my_filter.py:Wordy", "Wordy.*AffineConstraint"),
        ("my_filter.py:Short", "Short.*0 coefficients"),
    ],
)
def test_text_that_makes_no_filter_is_explained(stated, text, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        SafetyFilter.for_problem(SCALAR, text)


def test_a_constraint_may_hold_numbers_of_python(stated):
    safety_filter = SafetyFilter.for_problem(SCALAR, "my_filter.py:Constant")
    assert safety_filter.filter([0.5], [-1.0]).action == pytest.approx([0.0])


def test_an_evaluation_names_the_condition_and_where_it_is(stated):
    name = "my_filter.py:Eager:gain=2"
    found = evaluate("Scalar-v0", filters=["none", name], episodes=20, bounds=False)
    assert [row.filter for row in found.rows] == ["none", name]
    (spec,) = (f["spec"] for f in found.config["filters"] if f["name"] == name)
    assert spec.startswith(f"{stated.resolve()}/my_filter.py:Eager:gain=2.0")


@pytest.mark.slow
def test_a_condition_of_a_script_is_known_by_its_file_and_stated_once(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        STATED
        + """
from safe_envs.wrappers import parse_condition, spec_of

text = spec_of(Eager(2.0))
assert type(parse_condition(text, ())) is Eager
print(text)
"""
    )
    ran = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=True)
    assert ran.stdout.startswith(f"{script.resolve()}:Eager:gain=2.0")


@dataclass(frozen=True)
class Certain(Condition):
    """As a condition from outside says that it keeps every path."""

    stochastic = almost_sure = True

    def derived(self, model, barrier):
        h = barrier.expression
        return AffineConstraint.after(model, (h,), lie_derivative_f(model, h) + h)


def test_what_bounds_ask_of_a_condition_it_says_itself():
    from safe_envs.proofs.safe_set import Formulas

    assert Formulas(SCALAR, (Certain(),), "model").certain
    assert not Formulas(SCALAR, (CBF(),), "model").certain
    assert Certain.name == "Certain"
    assert spec_of(Certain()) == f"{__name__}:Certain"
