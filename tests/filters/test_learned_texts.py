"""Learned conditions as text, from files and from memory, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from safe_envs import Barrier, ConfigurationError
from safe_envs.filters.learning.data import LearnedFileError
from safe_envs.proofs.feasibility import verify
from safe_envs.proofs.posterior import PosteriorGuarantee, guarantee_of
from safe_envs.proofs.safe_set import Formulas
from safe_envs.wrappers import (
    DDSCBF,
    HOCBF,
    BayesianSCBF,
    LearnedHOCBF,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    parse_condition,
    parse_conditions,
    spec_of,
)
from tests.conftest import problem_of
from tests.wrappers.learned import assert_same_decisions, situations

pytestmark = pytest.mark.slow


KEPT = {
    "residual": ("disk", LearnedHOCBF, {"alpha": (1.0, 2.0), "eps": 0.0}, ":alpha=1,2:eps=0"),
    "network": ("top", DDSCBF, {"margin": 0.02}, ":margin=0.02"),
    "diffusion": ("gap", DDSCBF, {}, ""),
    "gap_posterior": ("gap", BayesianSCBF, {}, ""),
    "posterior": ("cubic", BayesianSCBF, {"confidence": 0.8}, ":confidence=0.8"),
    "simultaneous": ("cubic", BayesianSCBF, {"simultaneous": 0.9}, ":simultaneous=0.9"),
}


@pytest.fixture(params=KEPT)
def kept(request, tmp_path):
    """A problem, a condition, and the text of the same condition with a file."""
    path = tmp_path / "learned model.npz"
    env, kind, parameters, text = KEPT[request.param]
    name = "posterior" if request.param == "simultaneous" else request.param
    problem, learned = request.getfixturevalue(env), request.getfixturevalue(name)
    learned.save(path)
    return problem, kind(learned, **parameters), f"{kind.name}:file={path}{text}"


def test_a_condition_from_a_file_is_the_one_from_memory_to_the_last_bit(kept):
    problem, condition, text = kept
    (read,) = parse_conditions(text, problem)
    assert type(read) is type(condition)
    assert read.learned.sha256 == condition.learned.sha256
    x, u = situations(problem, 100)
    one, other = (SafetyFilter.for_problem(problem, c) for c in (condition, read))
    for states, inputs in ((x, u), (x[0], u[0]), (x[1], u[1])):
        for mine, theirs in zip(
            one.filter(states, inputs), other.filter(states, inputs), strict=True
        ):
            assert np.array_equal(mine, theirs)
    (again,) = parse_conditions(spec_of(read), problem)
    assert spec_of(again) == spec_of(read)
    assert again.parameters == read.parameters
    assert "file=" in spec_of(read)


def test_a_condition_from_memory_is_named_by_its_checksum_which_cannot_be_read(kept):
    problem, condition, _ = kept
    assert f"sha256={condition.learned.sha256[:12]}" in spec_of(condition)
    with pytest.raises(ConfigurationError, match=r"sha256.*file"):
        parse_conditions(spec_of(condition), problem)
    with pytest.raises(ConfigurationError, match=f"{condition.name}.*learned.*identify.*file=FILE"):
        parse_conditions(condition.name, problem)
    with pytest.raises(ConfigurationError, match="file=FILE"):
        parse_condition(condition.name, (1.0, 2.0))
    (given,) = parse_conditions(condition.name, problem, {condition.method: condition.learned})
    assert given.learned is condition.learned


def test_the_rates_of_a_problem_are_taken_where_none_are_given(disk, residual):
    (condition,) = parse_conditions(
        "learned-hocbf:eps=0.1:level=0.5", disk, {"learned-hocbf": residual}
    )
    assert (condition.alpha, condition.eps, condition.level) == (disk.gains_of(0), 0.1, 0.5)


def test_what_a_learned_condition_cannot_take_is_refused(disk, residual):
    learned = {"learned-hocbf": residual}
    for text, why in (
        ("learned-hocbf:eps=1,2", "one value"),
        ("learned-hocbf:rate=1", "no parameter 'rate'"),
        ("learned-hocbf:learned=1", "no parameter 'learned'"),
        ("learned-hocbf:eps=1:eps=2", "twice"),
        ("learned-hocbf:eps=big", "eps = 'big'"),
        ("hocbf:file=here", "no parameter 'file'"),
        ("learned-hocb", "did you mean 'learned-hocbf'"),
    ):
        with pytest.raises(ConfigurationError, match=why):
            parse_conditions(text, disk, learned)
    with pytest.raises(LearnedFileError, match="does not exist"):
        parse_conditions("learned-hocbf:file=/nowhere", disk)


def test_what_was_learned_of_another_system_is_refused(
    disk, top, gap, cubic, residual, network, posterior
):
    believed = problem_of("safe_envs/DubinsDisk-v0", model={"v": 0.4})
    moved = replace(disk, barriers=(Barrier(disk.barriers[0].expression - 1, "smaller"),))
    for problem, condition, message in (
        (believed, LearnedHOCBF(residual, alpha=(1.0, 2.0)), "model"),
        (moved, LearnedHOCBF(residual, alpha=(1.0, 2.0)), "learned for the barriers"),
        (gap, DDSCBF(network), "Pendulum"),
        (top, BayesianSCBF(posterior), "CubicSDEDisk"),
        (cubic, DDSCBF(posterior), "ddscbf.*bayesian"),
        (cubic, BayesianSCBF("posterior.npz"), "posterior.npz"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            SafetyFilter.for_problem(problem, condition)


def test_what_corrects_the_model_starts_from_it_whatever_is_known(disk, residual, cubic, posterior):
    condition = LearnedHOCBF(residual, alpha=(1.0, 2.0))
    known = [
        SafetyFilter.for_problem(disk, condition, knowledge) for knowledge in ("model", "plant")
    ]
    assert_same_decisions(disk, *known, tolerance=1e-12)
    both = replace(disk, barriers=disk.barriers * 2)
    with pytest.raises(
        ConfigurationError, match=r"learned-hocbf corrects the model.*knowledge='model'"
    ):
        SafetyFilter.for_problem(both, (condition, HOCBF((1.0, 2.0))), "plant")


def test_files_of_something_else_are_refused(tmp_path, disk, top, gap, cubic, request):
    for name in ("residual", "network", "diffusion", "posterior"):
        request.getfixturevalue(name).save(tmp_path / name)
    wider = problem_of("safe_envs/CubicSDEDisk-v0", barrier={"radius": 1.1})
    plain = problem_of("safe_envs/ACCGap-v0", barrier={"power": 1})
    obstacle = problem_of("safe_envs/DubinsObstacle-v0")
    large = problem_of("safe_envs/DubinsDisk-v0", barrier={"radius": 2.0})
    low = problem_of("safe_envs/Pendulum-v0", barrier={"level": 0.1})
    for text, problem, why in (
        ("ddscbf:file={}/posterior", cubic, "bayesian.*ddscbf"),
        ("bayesian-scbf:file={}/residual", disk, "learned-hocbf.*bayesian"),
        ("learned-hocbf:file={}/network", top, "ddscbf.*learned-hocbf"),
        ("learned-hocbf:file={}/residual", obstacle, "its system"),
        ("ddscbf:file={}/network", gap, "its system"),
        ("bayesian-scbf:file={}/posterior", gap, "its system"),
        ("learned-hocbf:file={}/residual", large, "its barriers"),
        ("ddscbf:file={}/network", low, "its barriers"),
        ("learned-hocbf:file={}/residual", disk.configured(model={"v": 1.7}), "its model"),
        ("ddscbf:file={}/network", top.configured(model={"l": 0.6}), "its model"),
        ("ddscbf:file={}/diffusion", gap.configured(model={"M": 1500.0}), "its model"),
    ):
        with pytest.raises(LearnedFileError, match=why):
            parse_conditions(text.format(tmp_path), problem)
    # What was learned of the whole system, or of its noise, is of use for any barrier.
    for text, problem in (
        ("bayesian-scbf:file={}/posterior", wider),
        ("ddscbf:file={}/diffusion", plain),
    ):
        (condition,) = parse_conditions(text.format(tmp_path), problem)
        x, u = situations(problem, 50)
        assert np.isfinite(SafetyFilter.for_problem(problem, condition).filter(x, u).action).all()


@pytest.mark.parametrize("kept", ["residual", "posterior"], indirect=True)
def test_the_wrappers_take_text_and_conditions(kept):
    problem, condition, text = kept
    env_id = f"safe_envs/{problem.name}-v0"
    env, again = (SafetyFilterWrapper(gym.make(env_id), given) for given in (text, condition))
    remade = gym.make(env.spec)
    vector, other = (
        SafetyFilterVectorWrapper(gym.make_vec(env_id, num_envs=2), given)
        for given in (text, condition)
    )
    for wrapped in (env, again, remade):
        wrapped.reset(seed=3)
    for wrapped in (vector, other):
        wrapped.reset(seed=[3, 4])
    one, two = (np.ones(e.action_space.shape, dtype=np.float32) for e in (env, vector))
    for _ in range(5):
        results = [wrapped.step(one) for wrapped in (env, again, remade)]
        batches = [wrapped.step(two) for wrapped in (vector, other)]
        for result in results:
            assert np.array_equal(result[4]["safe_action"], results[0][4]["safe_action"])
            assert np.array_equal(result[0], results[0][0])
        assert np.array_equal(batches[0][4]["safe_action"], batches[1][4]["safe_action"])
        np.testing.assert_allclose(
            batches[0][4]["safe_action"][0], results[0][4]["safe_action"], rtol=1e-9
        )
    with pytest.raises(ConfigurationError, match="sha256"):
        gym.make(again.spec)


@pytest.mark.parametrize(
    "kept",
    ["network", pytest.param("simultaneous", marks=pytest.mark.oracle)],
    indirect=True,
)
def test_bounds_are_for_known_systems_or_posteriors(kept):
    problem, condition, _ = kept
    looks = [
        lambda: Formulas(problem, [condition], "model"),
        lambda: verify(problem, [condition]),
        lambda: guarantee_of(problem, [condition]),
    ]
    if getattr(condition, "simultaneous", None) is not None:
        assert isinstance(looks.pop()(), PosteriorGuarantee)
    for look in looks:
        with pytest.raises(ConfigurationError, match="the condition is learned"):
            look()
