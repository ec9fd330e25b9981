"""`safe-envs certify`: a barrier whose bound of the safety is proved."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.files import require_writable
from safe_envs.scripts.options import completion, evaluation_options, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import (
    Json,
    progress_bar,
    require_result,
    stdout,
    write_result,
)
from safe_envs.scripts.options.env_options import EnvOptions, with_env_at_state

if TYPE_CHECKING:
    from safe_envs.problem.problem import SafetyProblem


@with_env_at_state
def certify(
    env: EnvOptions,
    degree: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Highest total degree of psi; by default it rises as long as that is better.",
        ),
    ] = None,
    policy: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            autocompletion=completion.policies,
            help="A bound for this policy alone: nominal. By default for every policy that meets"
            " psi's constraint.",
        ),
    ] = "",
    rates: Annotated[
        list[float] | None,
        typer.Option("--rate", metavar="A", help="a of the bound in 1/s, at least 0. Repeatable."),
    ] = None,
    seconds: Annotated[
        float, typer.Option(help="Time after which no higher degree is begun.")
    ] = 25.0,
    best: evaluation_options.Best = False,
    seed: text_options.Seed = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the certificate: a JSON file.")
    ] = None,
    json: Json = None,
) -> None:
    """Look for a polynomial psi that bounds how safe episodes are, and prove the bound.

    Linear programs choose psi for the largest mean bound over the env's starts, at sampled states;
    branch and bound then proves its numbers at all states. Each degree starts from the psi before,
    and is never worse. The bound is of continuous control. It holds for every policy whose input
    meets psi's constraint, which a filter ensures, and counts leaving the workspace in the safe
    set as safe.

    The exit status is 1 where no bound above 0 is proved.
    """
    from safe_envs.filters.certificates.files import save_certificate
    from safe_envs.proofs.certify import Named, SynthesisSettings
    from safe_envs.proofs.certify import certify as find
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.certify import CertifyAnswer, print_certification

    require_whole("seed", seed, 0)
    require_result(json)
    text_options.require_outputs(json, None, inputs=text_options.inputs_of(env.system))
    if out is not None:
        require_writable(out)
        if json is not None and out.resolve() == json.resolve():
            raise ConfigurationError(f"--out and --json are both {str(out)!r}; give two files")
    settings = SynthesisSettings(
        degrees=() if degree is None else (degree,),
        rates=tuple(rates or ()),
        seconds=seconds,
        seed=seed,
    )
    known, arguments = env.full_id, env.arguments
    problem = make_problem(known, **arguments)
    if policy:
        _require_formula(policy, problem)
    named = Named(problem, known if env.system is None else "", arguments)
    upper = _attainable(problem) if best else None
    with progress_bar("Searching") as tell:
        found = find(named, settings, bool(policy), tell)
    config = {"env_id": known, "options": arguments, "policy": policy or None, "seed": seed}
    answer = CertifyAnswer(title_of(known, arguments), config, problem, found, upper, out)
    if found.certificate is not None and out is not None:
        save_certificate(found.certificate, out)
    print_certification(stdout(), answer)
    write_result(json, answer.document)
    if found.certificate is None:
        sys.stdout.flush()
        raise SystemExit(1)


def _attainable(problem: SafetyProblem) -> float | None:
    """Return how safe any policy can be at most."""
    from safe_envs.agents.evaluation.attainable import best_for

    with progress_bar("Best attainable safety") as tell:
        return best_for(problem, tell).upper


def _require_formula(policy: str, problem: SafetyProblem) -> None:
    """Raise ConfigurationError unless a policy is a law of the state in symbols."""
    if policy == "nominal":
        return
    from safe_envs.agents.policies.registry import make_policy

    make_policy(policy, problem)  # An unknown one is an error.
    raise ConfigurationError(
        f"the policy {policy!r} has no formula of the state to prove a bound of; give --policy"
        " nominal, or leave it out for a bound that holds for every policy under psi's"
        " constraint"
    )


if __name__ == "__main__":
    run_alone("certify", certify)
