"""Learning what a model lacks: residuals of derivatives, unknown noise, or the whole system."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from safe_envs.errors import nearest, shown
from safe_envs.filters.learning.checks import Progress, require_problem
from safe_envs.filters.learning.data import DATA, LearnedFileError, load
from safe_envs.filters.learning.models.base import LearnedModel, Record
from safe_envs.problem.problem import SafetyProblem

__all__ = [
    "METHODS",
    "LearnedFileError",
    "LearnedModel",
    "Progress",
    "Record",
    "learner_of",
    "load_learned",
]

METHODS = {
    "learned-hocbf": ("residual", "ResidualModel", "learn_residual"),
    "ddscbf": ("generator", "GeneratorModel", "learn_generator"),
    "bayesian": ("bayesian", "Posterior", "identify"),
}
"""Module, model and function of each method; imported when they are needed, since they are heavy.
"""


def learner_of(method: str) -> Callable[..., LearnedModel]:
    """Return the learner of a method: (problem, *, seed, progress, ...) -> LearnedModel.

    Raises:
        LearnedFileError: the method is unknown.
    """
    return getattr(_module(method), METHODS[method][2])


def load_learned(
    path: Path | str, problem: SafetyProblem, method: str | None = None
) -> LearnedModel:
    """Read what was learned of a problem.

    Args:
        path: file that `LearnedModel.save` wrote.
        problem: for which it is to be used.
        method: which it has to be of; None for any.

    Raises:
        LearnedFileError: the path is empty, or the file is damaged, holds data, or is of another
            method or system.
    """
    if not str(path):
        raise LearnedFileError(
            "the path of a learned model is empty; name a file that `safe-envs identify` wrote"
        )
    require_problem(problem)
    content = load(Path(path))
    if content.kind == DATA:
        raise LearnedFileError(
            f"{path} holds transitions (data), no model; `safe-envs identify --data {path}` learns"
            " from it"
        )
    if method is not None and content.kind != method:
        raise LearnedFileError(f"{path} holds {content.kind}; {method} is needed here")
    model: LearnedModel = getattr(_module(content.kind), METHODS[content.kind][1]).from_content(
        content, problem
    )
    object.__setattr__(model, "path", Path(path))  # the models are frozen
    return model


def _module(method: str) -> Any:
    if method not in METHODS:
        raise LearnedFileError(f"unknown method {shown(method)}; {nearest(method, METHODS)}")
    return import_module(f"safe_envs.filters.learning.{METHODS[method][0]}")
