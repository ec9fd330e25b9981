"""Safety of episodes, interventions and infeasible steps during a training, for its logger."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter

from safe_envs.agents.jobs.store import reading
from safe_envs.agents.training.config import PromiseCurriculum
from safe_envs.files import write_atomically, writing

_EPISODES = 100

_LONGEST = 1_000_000
"""Characters of a line of a log, at most: it has some tens of numbers."""


class SafetyFigures(BaseCallback):
    """Counts over the infos of a `SB3VecEnv`, recorded under `safety/` after each rollout.

    | key | meaning |
    |---|---|
    | `rate` | share of the last 100 episodes without a violation |
    | `episode_cost` | their mean number of unsafe steps |
    | `h_min` | their mean smallest barrier value, where all have one |
    | `violations` | unsafe steps in the training so far |
    | `interventions`, `infeasible` | shares of all steps so far, with a filter |

    Attributes:
        counts: JSON-able, all that is needed to go on later.
    """

    def __init__(self) -> None:
        super().__init__()
        self.counts: dict[str, Any] = {"steps": 0, "violations": 0, "episodes": []}

    def _on_step(self) -> bool:
        batch = self.training_env.unwrapped.batch_info  # pyright: ignore[reportAttributeAccessIssue]
        counts, done = self.counts, np.flatnonzero(self.locals["dones"])
        counts["steps"] += len(batch["violation"])
        counts["violations"] += int(batch["violation"].sum())
        if "intervention" in batch:
            counts["interventions"] = counts.get("interventions", 0) + int(
                batch["intervention"].sum()
            )
            counts["infeasible"] = counts.get("infeasible", 0) + int((~batch["feasible"]).sum())
        if done.size:
            # Files have no -inf, which stands for a barrier without a value.
            lowest = [h if math.isfinite(h) else None for h in batch["h_min"][done].tolist()]
            ended = zip(batch["episode_cost"][done].tolist(), lowest, strict=True)
            counts["episodes"] = list(deque([*counts["episodes"], *map(list, ended)], _EPISODES))
        return True

    def _on_rollout_end(self) -> None:
        for name, value in self.figures().items():
            self.logger.record(f"safety/{name}", value)

    def restore(self, counts: Any) -> None:
        """Go on with the counts of another run.

        Raises:
            ValueError: they are not such counts.
        """
        whole = [count for name, count in counts.items() if name != "episodes"]
        ended = [number for episode in counts["episodes"] for number in episode]
        numbers: list[Any] = [n for place, n in enumerate(ended) if n is not None or place % 2 == 0]
        known = (
            {"steps", "violations", "episodes"}
            <= set(counts)
            <= {*self.counts, "interventions", "infeasible"}
        )
        if not (
            known
            and all(type(n) is int and n >= 0 for n in whole)
            and len(ended) == 2 * len(counts["episodes"]) <= 2 * _EPISODES
        ):
            raise ValueError(f"the counts are {list(counts)}")
        if not all(type(number) in (int, float) and math.isfinite(number) for number in numbers):
            raise ValueError("the last episodes are not numbers")
        self.counts = counts

    def figures(self) -> dict[str, float]:
        """Return the figures by name; those of episodes once one has ended."""
        counts = self.counts
        found = {"violations": float(counts["violations"])}
        found |= {
            name: counts[name] / counts["steps"]
            for name in ("interventions", "infeasible")
            if name in counts
        }
        if counts["episodes"]:
            cost, h_min = zip(*counts["episodes"], strict=True)
            found |= {
                "rate": float(np.mean(np.equal(cost, 0))),
                "episode_cost": float(np.mean(cost)),
            }
            if None not in h_min:
                found["h_min"] = float(np.mean(h_min))
        return found


class CurriculumCallback(BaseCallback):
    """Goes on with a curriculum after each step, and records it as `train/probability`.

    Args:
        curriculum: to follow.
    """

    def __init__(self, curriculum: PromiseCurriculum) -> None:
        super().__init__()
        self._curriculum, self._asked = curriculum, curriculum.first

    def _on_step(self) -> bool:
        self._asked = self._curriculum.ask(self.training_env, self.num_timesteps)
        return True

    def _on_rollout_end(self) -> None:
        self.logger.record("train/probability", self._asked)


class ProgressLog(KVWriter):
    """A log with a line of JSON for each dump, which a resumed training continues.

    Args:
        path: of the file.
        until: step of the checkpoint from which the training goes on; later lines are dropped.
    """

    def __init__(self, path: Path, until: int) -> None:
        self._path = path
        write_atomically(path, lambda part: _copy(path, part, until))

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Append a line; numbers that are not finite become null.

        Args:
            key_values: values by name, of which the numbers are kept.
            key_excluded: ignored.
            step: of the training.
        """
        numbers = {
            key: _number(value)
            for key, value in sorted(key_values.items())
            if isinstance(value, int | float | np.number)
        }
        with writing(self._path), self._path.open("a") as stream:
            stream.write(json.dumps({"step": step, **numbers}, allow_nan=False) + "\n")

    def close(self) -> None:
        """Do nothing: each line is written at once."""


def _copy(path: Path, to: Path, until: int) -> None:
    """Copy the lines of a log up to a step."""
    with to.open("w") as stream:
        stream.writelines(text for text, line in _lines(path) if line["step"] <= until)


def _lines(path: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the complete lines of a log, as text and as data."""
    if not path.is_file():
        return
    with reading(path, "remove it"), path.open() as stream:
        # The last line of a training that was killed may be incomplete.
        while (text := stream.readline(_LONGEST)).endswith("\n"):
            line = json.loads(text)
            if type(line["step"]) is not int:
                raise ValueError(f"a line is of step {line['step']!r}")
            yield text, line
        if len(text) == _LONGEST:
            raise ValueError("a line is too long")


def _number(value: Any) -> float | int | None:
    number = value.item() if isinstance(value, np.number) else value
    return number if math.isfinite(number) else None
