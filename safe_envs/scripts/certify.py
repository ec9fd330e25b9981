"""`safe-envs certify`: a barrier whose bound of the safety is proved."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from safe_envs.atomic_io import require_writable
from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.scripts.options import completion, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import progress_bar, require_result, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env

if TYPE_CHECKING:
    from safe_envs.problem.problem import SafetyProblem


@with_env
def certify(
    env: EnvOptions,
    degree: Annotated[
        int | None,
        typer.Option(metavar="N", help="Total degree of psi; by default several are tried."),
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
    seed: text_options.Seed = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the certificate: a JSON file.")
    ] = None,
    json: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write all that was found; - for stdout, and nothing else there."
        ),
    ] = None,
) -> None:
    """Look for a polynomial psi that bounds how safe episodes are, and prove the bound.

    Linear programs choose psi for the largest mean bound over the env's starts, at sampled states;
    branch and bound then proves its numbers at all states. The bound is of continuous control. It
    holds for every policy whose input meets psi's constraint, which a filter ensures; all of it
    counts leaving the workspace in the safe set as safe.

    The exit status is 1 where no bound above 0 is proved.
    """
    from safe_envs.registry import make_problem, title_of
    from safe_envs.scripts.reports.certify_report import (
        CertifyAnswer,
        attainable_upper,
        print_certification,
    )
    from safe_envs.wrappers.certificates.files import save_certificate
    from safe_envs.wrappers.synthesis.certify import Named
    from safe_envs.wrappers.synthesis.certify import certify as find
    from safe_envs.wrappers.synthesis.settings import SynthesisSettings

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
    with progress_bar("Searching") as tell:
        found = find(named, settings, bool(policy), tell)
    config = {"env_id": known, "options": arguments, "policy": policy or None, "seed": seed}
    upper = attainable_upper(problem)
    answer = CertifyAnswer(title_of(known, arguments), config, problem, found, upper, out)
    if found.certificate is not None and out is not None:
        save_certificate(found.certificate, out)
    print_certification(stdout(), answer)
    write_result(json, answer.document)
    if found.certificate is None:
        sys.stdout.flush()
        raise SystemExit(1)


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
