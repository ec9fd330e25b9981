"""The `safe-envs` command."""

from __future__ import annotations

import sys

_INTERRUPTED = 130
"""Exit status of a command that Ctrl-C ends."""

try:
    from safe_envs.scripts.options.app import CommandEntry, make_app, run_app
except KeyboardInterrupt:  # Whoever presses it at once waits for no traceback either.
    sys.exit(_INTERRUPTED)

_EVALUATE = "Evaluate and train"
_PROVE = "Prove and bound"
_SHOW = "Use and show"
_TOOLS = "Tools"

COMMANDS = tuple(
    CommandEntry(name, panel, f"safe_envs.scripts.{place}", about)
    for name, panel, place, about in (
        (
            "evaluate",
            _EVALUATE,
            "evaluate:evaluate",
            "Print the safety rate of a policy under each filter, and compare the filters in"
            " pairs.",
        ),
        (
            "identify",
            _EVALUATE,
            "identify:identify",
            "Learn of a system by a method, and print how far what was learned is from the truth.",
        ),
        (
            "train",
            _EVALUATE,
            "train:train",
            "Train an agent, evaluate it on the way, and keep the last and the best policy.",
        ),
        (
            "leaderboard",
            _EVALUATE,
            "leaderboard:leaderboard",
            "Train agents on envs, with and without filters, and compare safety, return and cost.",
        ),
        (
            "study",
            _EVALUATE,
            "study:study",
            "Train the agents of a study with several seeds, and compare them with and without"
            " filters.",
        ),
        (
            "sweep",
            _EVALUATE,
            "sweep:sweep",
            "Evaluate each cell of a sweep: one env, filter, policy, seed and set of parameters.",
        ),
        (
            "sweep-report",
            _EVALUATE,
            "sweep_report:sweep_report",
            "Draw the safety rates of a sweep with 95 % bands, and list its worst and its failed"
            " cells.",
        ),
        (
            "best",
            _PROVE,
            "best:best",
            "Print how safe any policy can be from the env's starts, and how safe a greedy policy"
            " is.",
        ),
        (
            "verify",
            _PROVE,
            "verify:verify",
            "Print where a filter's conditions cannot be met, and its bounds next to a simulation.",
        ),
        (
            "certify",
            _PROVE,
            "certify:certify",
            "Look for a polynomial psi that bounds how safe episodes are, and prove the bound.",
        ),
        (
            "check",
            _PROVE,
            "check:check",
            "Check the certificate in a file: what it states, and whether that is so.",
        ),
        (
            "export",
            _SHOW,
            "export:export",
            "Write a filter as C99: header, source, core, self-test, CMakeLists.txt and README.md.",
        ),
        (
            "render",
            _SHOW,
            "render:render",
            "Draw an episode: the scene to scale, the safe set, the trail, and the filtered"
            " actions.",
        ),
        (
            "demo",
            _SHOW,
            "demo:demo",
            "Train PPO briefly without a filter, then compare it with the nominal controller.",
        ),
        ("list", _TOOLS, "listing:list_envs", "List the registered envs."),
        ("doctor", _TOOLS, "doctor:doctor", "Check the installation."),
        (
            "cache",
            _TOOLS,
            "cache:cache",
            "Print what is kept in the user's cache, or clear it.",
        ),
    )
)
"""All commands, in the order of the help."""

MOVED = {
    "frontier": "`safe-envs sweep examples/frontier.yaml --out DIR --plot FILE`, over filters"
    " promise:p=... at several p",
    "reproduce": "`python -m thesis` or `make thesis` in a checkout",
    "benchmark": "`python -m benchmarks` or `make benchmark` in a checkout",
}
"""What to run in place of commands that there were."""

app = make_app(COMMANDS, MOVED)


def main() -> None:
    """Run the command line."""
    try:
        run_app(app)
    except KeyboardInterrupt:
        sys.exit(_INTERRUPTED)


if __name__ == "__main__":
    main()
