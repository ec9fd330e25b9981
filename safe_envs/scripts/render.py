"""`safe-envs render`: an episode as a video, an animation or a still, under some filters."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from safe_envs.errors import ConfigurationError, shown
from safe_envs.scripts.figures.film import require_film, steps_a_frame, write_film
from safe_envs.scripts.options import early_checks, evaluation_options, text_options
from safe_envs.scripts.options.app import run_alone
from safe_envs.scripts.options.console import Json, progress_bar, say, stdout, write_result
from safe_envs.scripts.options.env_options import EnvOptions, with_env_at_state

if TYPE_CHECKING:
    from safe_envs.agents.evaluation.resolve import FilterParts
    from safe_envs.problem.problem import SafetyProblem


@with_env_at_state
def render(
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="FILE",
            help="A .mp4 or .gif of the whole episode in real time, or a .png of its end.",
            show_default=False,
        ),
    ],
    env: EnvOptions,
    filter_name: Annotated[
        str | None,
        typer.Option(
            "--filter",
            metavar="NAME",
            callback=early_checks.known_filter,
            help="As for evaluate: none, scbf, hocbf:alpha=2,8, ... By default the env's own.",
        ),
    ] = None,
    compare: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help=(
                "In place of --filter: several, with commas between, side by side from the same"
                " start with the same noise: "
                "none,hocbf:alpha=2,8,scbf. A comma that no filter's name follows belongs to the"
                " filter before it."
            ),
        ),
    ] = None,
    policy: evaluation_options.Policy = "nominal",
    trust: text_options.Trust = False,
    seed: text_options.Seed = 0,
    knowledge: text_options.Knowledge = "model",
    learned: evaluation_options.Learned = None,
    json_file: Json = None,
) -> None:
    """Draw an episode: the scene to scale, the safe set, the trail, and the filtered actions.

    The episode is that of an env which is reset with the seed. Learned filters are
    learned first, unless --learned gives the model.
    """
    from safe_envs.registry import make_problem

    if filter_name is not None and compare is not None:
        raise ConfigurationError(
            f"--filter {filter_name} and --compare {compare} are both there; give one of them"
        )
    require_film(out)
    if compare is not None:
        names = split_filters(compare)
    else:
        names = [] if filter_name is None else [filter_name]
    text_options.require_outputs(
        json_file,
        None,
        out=out,
        inputs=text_options.inputs_of(env.system, policy, names, learned or ()),
    )
    problem = make_problem(env.full_id, **env.arguments)
    still = out.suffix.lower() == ".png"
    with progress_bar("Drawing") as tell:
        runs = make_runs(
            problem,
            names or [problem.filter],
            policy,
            trust=trust,
            seed=seed,
            knowledge=knowledge,
            learned=learned or (),
        )
        every = problem.steps if still else steps_a_frame(out, problem.dt, problem.steps)
        count = write_film(out, frames_of(runs, every, problem.steps, tell), every * problem.dt)
    console = stdout()
    for each in runs:
        say(console, each.summary())
    size = "a still" if still else f"{count} frames, {count * every * problem.dt:.2f} s"
    say(console, f"{out}: {size}")
    write_result(
        json_file,
        lambda: {"film": str(out), "frames": count, "episodes": [each.document() for each in runs]},
    )


def split_filters(text: str) -> list[str]:
    """Return the filters of --compare, each once.

    A comma divides two of them where the name of a filter follows it.

    Raises:
        ConfigurationError: one has no text.
    """
    from safe_envs.agents.evaluation.spec import UNFILTERED
    from safe_envs.filters.conditions.syntax import head_pattern

    found = [part.strip() for part in re.split(rf",(?=\s*{head_pattern(UNFILTERED)})", text)]
    if not all(found):
        raise ConfigurationError(
            f"--compare {shown(text)} names no filter at one place; give names with commas between:"
            " none,scbf"
        )
    return list(dict.fromkeys(found))


class Run:
    """An episode under a filter, step by step.

    Args:
        name: of the filter, "none" without.
        conditions: of the filter, see `FilterParts`.
        problem: what is simulated.
        actor: the policy, anything with Stable-Baselines3's `predict`; each run has its own.
        seed: of the start and of the noise.
        knowledge: of the filter.
    """

    def __init__(
        self,
        name: str,
        conditions: FilterParts,
        problem: SafetyProblem,
        actor: Any,
        seed: int,
        knowledge: str,
    ) -> None:
        from safe_envs.agents.policies.base import Policy
        from safe_envs.envs.env import SafeEnv
        from safe_envs.wrappers.safety_filter import SafetyFilterWrapper

        self.name, self._actor = name, actor
        self._world = SafeEnv(problem, render_mode="rgb_array")
        self._env = (
            SafetyFilterWrapper(self._world, conditions, knowledge) if conditions else self._world
        )
        if self._world.viewer is not None:
            self._world.viewer.caption = f"filter {name}" if conditions else "no filter"
        if isinstance(actor, Policy):
            actor.begin(range(1), seed)
        self._observation, self._info = self._env.reset(seed=seed)
        self._state: Any = None
        self._dt, self._steps = problem.dt, 0
        self._violated_at: float | None = None if self._info["cost"] == 0.0 else 0.0
        self.ended = False

    def step(self) -> None:
        """Move on by a control period, unless the episode has ended."""
        if self.ended:
            return
        first = np.array([self._steps == 0])
        actions, self._state = self._actor.predict(
            self._observation[None], self._state, first, deterministic=True
        )
        self._observation, _, terminated, truncated, self._info = self._env.step(actions[0])
        self._steps += 1
        self.ended = terminated or truncated
        if self._violated_at is None and self._info["cost"]:
            self._violated_at = self._steps * self._dt

    def frame(self) -> np.ndarray:
        """Return a picture of where the episode is."""
        return self._world.render()

    def summary(self) -> str:
        """Return how the episode went."""
        safe = "safe" if self._violated_at is None else f"violation at {self._violated_at:.2f} s"
        share = (
            f", {self._info['episode_interventions']} interventions"
            if "episode_interventions" in self._info
            else ""
        )
        return (
            f"{self.name}: {safe}, minimum h {self._info['h_min']:.3g}{share},"
            f" {self._steps * self._dt:.2f} s"
        )

    def document(self) -> dict[str, Any]:
        """Return the same as JSON-able data."""
        return {
            "filter": self.name,
            "violated_at": self._violated_at,
            "h_min": h if math.isfinite(h := float(self._info["h_min"])) else None,
            "interventions": self._info.get("episode_interventions"),
            "seconds": self._steps * self._dt,
        }


def make_runs(
    problem: SafetyProblem,
    names: Sequence[str],
    policy: str,
    *,
    trust: bool,
    seed: int,
    knowledge: str,
    learned: Sequence[Path],
) -> list[Run]:
    """Return an episode for each filter, all with the same seed, at its start.

    Args:
        problem: what is simulated.
        names: of the filters.
        policy: name of the policy.
        trust: load a policy's .zip, which runs code in it.
        seed: of start, noise and learning.
        knowledge: of the filters.
        learned: files of learned models.

    Raises:
        ConfigurationError: a filter or the policy is unknown or does not fit the problem.
        RelativeDegreeError: a filter does not suit a barrier.
    """
    from safe_envs.agents.evaluation.resolve import ResolvedEvaluation
    from safe_envs.agents.evaluation.spec import UNFILTERED, EvaluationSpec
    from safe_envs.agents.policies.registry import make_policy
    from safe_envs.filters.conditions.syntax import require_known

    for name in names:
        # A comma that is left in the name is one of --compare before an unknown name.
        words = [word.strip() for word in re.split("[:+]", name)[0].split(",")]
        for word in words[:-1] and [word for word in words if word != UNFILTERED]:
            require_known(word, UNFILTERED)
    spec = EvaluationSpec(
        problem, policy, names, learned=learned, trust=trust, seed=seed, knowledge=knowledge
    )
    resolved = ResolvedEvaluation(spec)
    resolved.learn(lambda: None)
    return [
        Run(name, conditions, problem, make_policy(policy, problem, trust), seed, knowledge)
        for name, (conditions, *_) in resolved.filters.items()
    ]


def frames_of(
    runs: Sequence[Run], every: int, steps: int, tell: Callable[[float], None] | None
) -> Iterator[np.ndarray]:
    """Yield pictures of the episodes side by side: first, after some steps each, and last.

    An episode that ended before the others stays as it was.

    Args:
        runs: the episodes.
        every: control periods from one picture to the next.
        steps: most control periods.
        tell: called with the part that is done.
    """
    yield _side_by_side(runs)
    k = 0
    while not all(each.ended for each in runs):
        for each in runs:
            each.step()
        k += 1
        if k % every == 0 or all(each.ended for each in runs):
            yield _side_by_side(runs)
        if tell:
            tell(k / steps)


def _side_by_side(runs: Sequence[Run]) -> np.ndarray:
    return np.concatenate([each.frame() for each in runs], axis=1)


if __name__ == "__main__":
    run_alone("render", render)
