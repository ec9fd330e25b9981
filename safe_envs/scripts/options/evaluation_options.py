"""Options of commands that evaluate or show filters and policies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.scripts.options import completion, early_checks, text_options

LEARNED_PARAMETERS = (
    "learned-hocbf:alpha=..:level=.95:eps=.. (quantile of the held-out errors that is the margin,"
    " or the margin itself), ddscbf:margin=0, bayesian-scbf:confidence=P or"
    " bayesian-scbf:simultaneous=P (robust at each state by itself, or at all at once), and with"
    " each file=FILE, as by --learned, and sampling_margin=M"
)

Filters = Annotated[
    list[str] | None,
    typer.Option(
        "--filter",
        metavar="NAME",
        autocompletion=completion.filters,
        callback=early_checks.known_filters,
        help=(
            "none, cbf, ecbf, hocbf, rcbf, srcbf, szcbf or scbf; with parameters: hocbf:alpha=2,8;"
            " one for each barrier: hocbf:alpha=2,8+cbf:alpha=1; promise:p=0.99, which keeps a"
            " probability of being safe; backup, which lets pass what a backup law of the"
            " env can make good;"
            " certified:file=FILE, of a barrier certificate; learned: learned-hocbf, ddscbf,"
            " bayesian-scbf; a condition of your own: FILE.py:NAME. Repeatable. By default none and"
            " the env's own."
        ),
    ),
]
Policy = Annotated[
    str,
    typer.Option(
        metavar="NAME|FOLDER|FILE",
        autocompletion=completion.policies,
        callback=early_checks.known_policy,
        help=(
            "nominal, clf, zero, random, best (as safe as a table shows to be possible), a policy"
            " of your own as FILE.py:NAME (an object with predict, a class or a function that makes"
            " one of the problem, or a function of a batch of observations), a folder of"
            " `safe-envs train`, or with --trust a .zip of Stable-Baselines3."
        ),
    ),
]
FilterSpecPlace = Annotated[
    str | None,
    typer.Option(
        metavar="FILE.py:NAME",
        help=(
            "For the ENV_ID of a third-party env, like Pendulum-v1: a FilterSpec that says how"
            " filters see it. Runs the file."
        ),
    ),
]
Estimator = Annotated[
    str | None,
    typer.Option(
        metavar="kf|ekf|ukf",
        callback=early_checks.known_estimator,
        help=(
            "With --measurement: estimate the state; ekf:process_noise=.1 for what the model does"
            " not know. Each filter then has rows at the true state (NAME@state), at the estimate,"
            " and with the belief (NAME:belief=P)."
        ),
    ),
]
Belief = Annotated[
    float,
    typer.Option(
        metavar="P",
        callback=early_checks.between_0_and_1("belief", 0.05),
        help="Probability with which errors of the estimate exceed the margin of those rows.",
    ),
]
Observe = Annotated[
    str,
    typer.Option(
        metavar="estimate|measurement",
        callback=early_checks.one_of("observe", ("estimate", "measurement")),
        help="What policies see with --estimator: the env's features at the estimate, or the"
        " measurement.",
    ),
]
Objective = Annotated[
    str,
    typer.Option(
        metavar="nearest|clf",
        callback=early_checks.one_of("objective", ("nearest", "clf")),
        help="Of the filters: the action nearest to the policy's, or the joint QP with the goal.",
    ),
]
Learned = Annotated[
    list[Path] | None,
    typer.Option(
        "--learned",
        metavar="FILE",
        help=(
            "What `safe-envs identify` wrote, for the learned filters. Repeatable. Parameters of"
            f" these filters: {LEARNED_PARAMETERS}."
        ),
    ),
]
Episodes = Annotated[
    int | None, typer.Option(min=1, show_default="1000", help="Episodes for each filter.")
]
Repeats = Annotated[
    int,
    typer.Option(
        min=1, help="How often to learn, with new seeds: intervals are over identifications too."
    ),
]
Confidence = Annotated[
    float,
    typer.Option(
        metavar="C",
        callback=early_checks.between_0_and_1("confidence", 0.95),
        help="Of all intervals, above 0 and below 1.",
    ),
]
Refine = Annotated[
    bool,
    typer.Option(
        "--refine",
        help="Repeat with dt/2 and dt/4, and extrapolate the safety rate to dt -> 0.",
    ),
]
Bounds = Annotated[
    bool,
    typer.Option(
        "--bounds/--no-bounds",
        help="Look for bounds of the safety, which takes some seconds for each filter.",
        show_default=False,
    ),
]
Best = Annotated[
    bool,
    typer.Option(
        "--best/--no-best",
        help=(
            "Compute the best attainable safety, and how many times the unavoidable violations each"
            " filter has."
        ),
        show_default=False,
    ),
]
ClosedLoop = Annotated[
    bool,
    typer.Option(
        "--closed-loop/--no-closed-loop",
        help=(
            "Compute a certified lower bound for each filter whose controller has a formula, by"
            " tables of closed loops: up to two states, about a minute each."
        ),
        show_default=False,
    ),
]
Monitoring = Annotated[
    str,
    typer.Option(
        metavar="discrete|continuous",
        callback=early_checks.one_of("monitoring", ("discrete", "continuous")),
        help="Check h at control instants only, or by Brownian bridges between them too.",
    ),
]
Rare = Annotated[
    bool,
    typer.Option(
        "--rare",
        help="Estimate P(violation) where it is too small for plain episodes, by splitting on h.",
    ),
]
Particles = Annotated[
    int | None,
    typer.Option(
        show_default="250 to 4000, as many as make the repetitions differ little",
        help="With --rare, in place of --episodes: episodes of a repetition.",
    ),
]
Repetitions = Annotated[
    int | None,
    typer.Option(show_default="20", help="With --rare: independent ones, which give the interval."),
]
NumEnvs = Annotated[
    int | None,
    typer.Option(
        min=1,
        show_default="1024",
        help="Episodes side by side; it changes the speed, not the answer.",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        show_default="1, or all",
        help=(
            "Processes, or threads of the compiled engine; they change the speed, not the answer."
        ),
    ),
]
JsonOut = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help=(
            "Write configuration, versions, rows, comparisons and timing; - for stdout, and"
            " nothing else there."
        ),
    ),
]
Latex = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help=(
            "Write the table and the comparisons in LaTeX, with booktabs; - for stdout, and nothing"
            " else there."
        ),
    ),
]
Timing = Annotated[
    bool,
    typer.Option("--timing", help="Print the times too: of learning, and steps per second."),
]
EpisodesOut = Annotated[
    Path | None,
    typer.Option(metavar="FILE.parquet", help="Write what became of each episode; needs pyarrow."),
]
Plot = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help=(
            "Draw h and the safety rate over time, trajectories, and the inputs of the first"
            f" episode: {text_options.FORMATS}"
        ),
    ),
]


Leaving = Annotated[
    str,
    typer.Option(
        metavar="violation|safe",
        help=(
            "How an episode counts that leaves the workspace in the safe set; evaluate counts it as"
            " safe."
        ),
    ),
]
Cells = Annotated[
    str | None,
    typer.Option(
        metavar="N|NxM|NxMxL",
        help="Cells of the grid along each coordinate; by default as many as suit the env.",
        show_default=False,
    ),
]
Inputs = Annotated[
    int | None,
    typer.Option(
        help="Inputs that are tried along each input; by default as many as suit the env.",
        show_default=False,
    ),
]
Table = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="The table: read if it is there, else written. By default it is in the cache.",
        show_default=False,
    ),
]


_MOST_DIGITS = 9


def cells_of(text: str | None) -> tuple[int, ...] | None:
    """Return the numbers of cells of a text such as 400x100; None for none.

    Args:
        text: as given.

    Raises:
        ConfigurationError: It is no such text.
    """
    if text is None:
        return None
    parts = text.lower().split("x")
    if not all(part.isascii() and part.isdigit() and len(part) <= _MOST_DIGITS for part in parts):
        raise ConfigurationError(
            f"--cells {shown(text)}; give a whole number for each coordinate, of at most"
            f" {_MOST_DIGITS} digits, such as 400x100"
        )
    return tuple(int(part) for part in parts)


WIDTHS = {"single": 3.5, "double": 7.16}
"""Widths in inches of a figure of one column of a paper and of two.

Source: IEEE Author Center, "Resolution and size" of graphics: 3.5 in and 7.16 in.
"""

DEFAULT_SIZE = "double"

Size = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(WIDTHS),
        help="Width of the figure in columns of a paper: {single:g} or {double:g} inches;"
        " {default} by default.".format(**WIDTHS, default=DEFAULT_SIZE),
    ),
]


def size_of(size: str | None, plot: Path | None) -> str:
    """Return the size of the figure of a command.

    Args:
        size: as given; None where it is not.
        plot: file of the figure; None where none is drawn.

    Raises:
        ConfigurationError: there is no such size, or no figure.
    """
    if size is None:
        return DEFAULT_SIZE
    width_of(size)
    if plot is None:
        raise ConfigurationError(
            f"--size {size} is of a figure, and none is drawn: give --plot FILE too, or leave"
            " --size out"
        )
    return size


def width_of(size: str) -> float:
    """Return the width of a figure.

    Args:
        size: "single" or "double".

    Returns:
        Inches.

    Raises:
        ConfigurationError: there is no such size.
    """
    if size not in WIDTHS:
        raise ConfigurationError(f"size = {shown(size)}; {nearest(str(size), list(WIDTHS))}")
    return WIDTHS[size]
