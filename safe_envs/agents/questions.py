"""One call for each question: what a filter, any filter or a certificate does for a problem.

A problem may be given by its id. The modules behind have more settings and more of the answer.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from safe_envs.agents.evaluation.attainable import AttainableSafety, attainable_safety
from safe_envs.agents.jobs.executor import Backend, run
from safe_envs.agents.jobs.job import JobOutcome
from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.certificate import BarrierCertificate
from safe_envs.filters.certificates.checker import CheckResult
from safe_envs.filters.certificates.checker import check as check_certificate
from safe_envs.filters.certificates.files import load_certificate
from safe_envs.filters.conditions.text import parse_conditions
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs import certify as synthesis
from safe_envs.proofs import feasibility
from safe_envs.registry import full_id, make_problem
from safe_envs.values.tables import ValueSettings

if TYPE_CHECKING:
    import pyarrow as pa

    from safe_envs.agents.policies.best import BestPolicy

Given = SafetyProblem | str
"""A problem, or the id of its env."""


def verify(
    problem: Given,
    filter: str | None = None,  # noqa: A002  (as everywhere)
    knowledge: str = "model",
    seed: int = 0,
) -> feasibility.Verification:
    """Look for safe states in which a filter has no feasible action.

    Args:
        problem: the problem or its id.
        filter: text of the filter; that of the problem by default.
        knowledge: what the filter knows, "model" or "plant".
        seed: of all draws.

    Returns:
        What was found in the safe set and in the set that the filter keeps.

    Raises:
        ConfigurationError: An argument is not allowed, or no safe state was found.
        RelativeDegreeError: The filter does not suit a barrier.
    """
    stated = _problem(problem)
    conditions = parse_conditions(filter or stated.filter, stated)
    return feasibility.verify(stated, conditions, knowledge, seed=seed)


def certify(problem: Given, policy: bool = False, **settings: Any) -> synthesis.Certification:
    """Look for a barrier certificate, and prove it.

    Args:
        problem: the problem or its id.
        policy: whether it is of the nominal controller, in place of every input that meets its
            constraint.
        **settings: of `safe_envs.proofs.certify.SynthesisSettings`, such as `degrees`.

    Returns:
        The certificate with its bound, or why there is none.

    Raises:
        ConfigurationError: A setting is out of range, or there is no certificate of such a problem.
    """
    env_id = full_id(problem) if isinstance(problem, str) else ""
    named = synthesis.Named(_problem(problem), env_id)
    return synthesis.certify(named, synthesis.SynthesisSettings(**settings), policy)


def check(certificate: BarrierCertificate | Path | str, seconds: float = 120.0) -> CheckResult:
    """Check a certificate or the file of one; no code in a file is run.

    Args:
        certificate: the certificate or its file.
        seconds: limit of time.

    Raises:
        ConfigurationError: The file holds no certificate, or the limit is not positive.
    """
    if not 0.0 < seconds < float("inf"):
        raise ConfigurationError(f"seconds = {seconds}; give a number above 0")
    if isinstance(certificate, str | Path):
        certificate = load_certificate(certificate)
    return check_certificate(certificate, seconds=seconds)


def best(
    problem: Given, episodes: int = 1000, seed: int = 0, **settings: Any
) -> tuple[AttainableSafety, BestPolicy]:
    """Compute how safe any policy can be from a problem's starts.

    Args:
        problem: the problem or its id.
        episodes: of the simulation of the safest policy; 0 for none.
        seed: of the simulation.
        **settings: of `safe_envs.values.tables.ValueSettings`, such as `cells`; the table is of the
            plant by default.

    Returns:
        What was found, and the safest policy of its table.

    Raises:
        ConfigurationError: A number is out of range, or there is no table of the problem.
    """
    found = ValueSettings(**{"knowledge": "plant", **settings})
    return attainable_safety(_problem(problem), found, episodes=episodes, seed=seed)


def sweep(
    file: Path | str, out: Path | str, jobs: int = 2, trust: bool = False, engine: str = "auto"
) -> pa.Table:
    """Evaluate each cell of a sweep that the folder does not hold yet.

    Args:
        file: of the sweep, in YAML.
        out: folder of the results.
        jobs: number of processes.
        trust: whether files that the sweep names may run code.
        engine: of the simulation, "auto", "compiled" or "numpy".

    Returns:
        A row for each cell, also for those that were there before.

    Raises:
        ConfigurationError: The file is no sweep, or cells failed.
    """
    from safe_envs.agents.sweeps.spec import read_sweep
    from safe_envs.agents.sweeps.store import Store, read

    store = Store(Path(out), read_sweep(Path(file), trust, engine))
    errors: list[str] = []

    def keep(outcome: JobOutcome) -> None:
        store.keep(outcome)
        errors.extend([outcome.error] if outcome.error else [])

    run(store.missing, Backend(jobs=jobs), keep)
    if errors:
        raise ConfigurationError(f"{len(errors)} cells failed, the first one with: {errors[0]}")
    return read(out)


def _problem(given: Given) -> SafetyProblem:
    return make_problem(given) if isinstance(given, str) else given
