"""The layer itself: decisions of a filter, with the gradients of its active sets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from safe_envs.errors import ConfigurationError, InvalidInputError, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions.spec_text import Conditions
from safe_envs.wrappers.conditions.text_parts import name_by_itself
from safe_envs.wrappers.filter_qp import FilterQP
from safe_envs.wrappers.filter_qp.limits import WIDEST
from safe_envs.wrappers.safety_filter import SafetyFilter
from safe_envs.wrappers.torch_layer.active_set import ActiveSets, nearest_step
from safe_envs.wrappers.torch_layer.expressions import compiled_constraints

_AGREED = 1e-6
"""How far apart, as a share of the input bounds, an action and its formula are, at most."""


class TorchResult(NamedTuple):
    """What a filter decides, for a batch with leading axes `...`, m inputs and k constraints.

    Attributes:
        action: executed input, shape (..., m), within the input bounds; only this one has a
            gradient.
        feasible: whether some action within the input bounds meets every constraint, shape (...).
        active: constraints that bind or cannot be met, shape (..., k).
        differentiable: whether the gradient is that of the action, shape (...); where not, it is
            zero. It says so whether or not a gradient was asked for.
    """

    action: torch.Tensor
    feasible: torch.Tensor
    active: torch.Tensor
    differentiable: torch.Tensor


class TorchFilter(torch.nn.Module):
    """A safety filter in physical units, differentiable in the proposed input and in the state.

    Where the constraints cannot all be met, the action is the least-violating one, and its gradient
    is that of this action: zero along the inputs that stay in a corner of the input bounds, and
    with several constraints that of their weighted compromise. Where the formula does not give the
    action, as it may not where its equations are nearly dependent, the gradient is zero, and the
    result says so.

    It runs on the CPU and in double precision, whatever the tensors are.

    Args:
        safety_filter: whose actions are returned.

    Raises:
        ConfigurationError: a constraint is not a plain one: uncertain, reciprocal, with a network
            or a sampling margin of first order; or the filter pursues a goal, or acts by itself, as
            the promise filter; or a constraint holds a function that torch does not have.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        super().__init__()
        if not isinstance(safety_filter, SafetyFilter):
            raise _not_differentiable(type(safety_filter).__name__)
        # The formula is of constraints, of which a barrier may have several.
        safety_filter = safety_filter.by_constraint()
        # The filter keeps its qp to its solvers, which share it.
        qp = safety_filter.qp
        _require_plain(safety_filter, qp)
        self.safety_filter = safety_filter
        self._sets = ActiveSets(qp)
        self._constraints = compiled_constraints(qp)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the compiled constraints, which a copy makes itself."""
        return {key: value for key, value in vars(self).items() if key != "_constraints"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._constraints = compiled_constraints(self.safety_filter.qp)

    @classmethod
    def for_problem(
        cls,
        problem: SafetyProblem,
        conditions: Conditions,
        knowledge: str = "model",
        priorities: Sequence[float] | None = None,
    ) -> TorchFilter:
        """Return the filter for the barriers of a problem; see `SafetyFilter.for_problem`."""
        if isinstance(conditions, str) and name_by_itself(conditions):
            raise _not_differentiable(conditions)
        return cls(SafetyFilter.for_problem(problem, conditions, knowledge, priorities=priorities))

    def forward(self, x: torch.Tensor, u: torch.Tensor, return_result: bool = False) -> Any:
        """Decide for a batch.

        Args:
            x: states, shape (..., n).
            u: proposed inputs, shape (..., m), in physical units.
            return_result: whether to return the flags with the action.

        Returns:
            The action, shape (..., m), of the type of `u` and on its device; or a `TorchResult`
            with it.

        Raises:
            InvalidInputError: a shape or a type does not fit, or an entry is not finite.
            NumericalError: a constraint has no finite value at a state.
        """
        if not (isinstance(x, torch.Tensor) and isinstance(u, torch.Tensor)):
            raise InvalidInputError(
                f"state {type(x).__name__} and input {type(u).__name__}; give tensors, such as"
                " torch.as_tensor(x)"
            )
        if not (x.is_floating_point() and u.is_floating_point()):
            raise InvalidInputError(
                f"state {x.dtype} and input {u.dtype}; give real floating-point tensors, such as"
                " x.double()"
            )
        given = [part.detach().to("cpu", torch.float64).numpy() for part in (x, u)]
        found = self.safety_filter.filter(*given)
        action, differentiable = (
            torch.from_numpy(found.action),
            torch.ones(found.action.shape[:-1], dtype=torch.bool),
        )
        if return_result or (torch.is_grad_enabled() and (x.requires_grad or u.requires_grad)):
            states, inputs = [
                part.to("cpu", torch.float64).reshape(-1, part.shape[-1]) for part in (x, u)
            ]
            formula, agrees = self._formula(states, inputs, found)
            formula, differentiable = (
                formula.reshape(action.shape),
                agrees.reshape(differentiable.shape),
            )
            action = action + (formula - formula.detach())
        action = action.to(u.device, u.dtype)
        flags = [
            torch.as_tensor(part, device=u.device)
            for part in (found.feasible, found.active, differentiable)
        ]
        return TorchResult(action, *flags) if return_result else action

    def _formula(
        self, states: torch.Tensor, inputs: torch.Tensor, found: Any
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actions (B, m) as functions of states (B, n) and inputs (B, m).

        Returns:
            The formulas, which hold near these states and inputs, and where they do (B,).
        """
        sets = self._sets
        m, k = len(sets.low), len(sets.priorities)
        action, active, slack = (
            found.action.reshape(-1, m),
            found.active.reshape(-1, k),
            found.slack.reshape(-1, k),
        )
        # Where no constraint acts, the state's gradient is zero, and not missing.
        result = (
            inputs.clamp(torch.from_numpy(sets.low), torch.from_numpy(sets.high))
            + 0.0 * states[:, :1]
        )
        everywhere = torch.ones(len(states), dtype=torch.bool)
        acting = np.flatnonzero(active.any(axis=1))
        if self.safety_filter.qp.partial and acting.size:
            # With a barrier without a value there is no formula.
            with torch.no_grad():
                parts = self._constraints(states[acting])
            lost = ~torch.stack([p.isfinite().flatten(1).all(dim=1) for p in parts]).all(dim=0)
            without = torch.from_numpy(acting)[lost]
            result = result.index_copy(0, without, torch.from_numpy(action)[without])
            everywhere[without] = False
            acting = acting[~lost.numpy()]
        if not acting.size:
            return result, everywhere
        places = torch.from_numpy(acting)
        a, b = self._constraints(states[places])
        held, missed, binding = sets.of(
            a.detach().numpy(),
            inputs.detach().numpy()[acting],
            action[acting],
            active[acting],
            slack[acting],
        )
        decided = torch.from_numpy(action[acting])
        start = torch.where(torch.from_numpy(held), decided, inputs[places])
        gaps = (a * start[:, None, :]).sum(dim=-1) + b
        roots = torch.from_numpy(sets.roots)
        rows = torch.where(torch.from_numpy(held)[:, None, :], 0.0, a / roots)
        weights = missed * np.sqrt(sets.priorities)
        solution = start + nearest_step(rows, gaps, weights, binding) / roots
        agrees = (
            (solution - decided).abs() <= torch.from_numpy(_AGREED * (sets.high - sets.low))
        ).all(dim=1)
        formula = torch.where(agrees[:, None], solution, decided)
        return result.index_copy(0, places, formula), everywhere.index_copy(0, places, agrees)


def _not_differentiable(given: str) -> ConfigurationError:
    return ConfigurationError(
        f"{shown(given)} is no SafetyFilter, and a torch layer takes no other; the promise filter"
        " looks its inputs up in a table, and the backup filter searches for them, so they have no"
        " gradient. Take a condition here, such as 'scbf' or 'hocbf'; or train an agent behind it,"
        " which needs no gradient of it, by SafetyFilterVectorWrapper or"
        " make_sb3_env(..., filter='promise:p=0.99')"
    )


def _require_plain(safety_filter: SafetyFilter, qp: FilterQP) -> None:
    if safety_filter.of_measurements:
        raise ConfigurationError(
            f"the filter has {safety_filter.of_measurements}, and a torch layer decides at states"
            " that it is given: leave that out, and give it the estimate as the state"
        )
    if qp.runtime:
        raise ConfigurationError(
            f"the filter takes {', '.join(map(str, qp.runtime))} at each call, which a torch layer"
            " does not; make them states or fixed parameters"
        )
    if max(map(abs, (*qp.low, *qp.high))) >= WIDEST:
        raise ConfigurationError(
            "the filter has input bounds without an end, and a torch layer measures by their width"
            " what holds an action; give finite ones"
        )
    if qp.clf is not None:
        raise ConfigurationError(
            "a filter with a clf does not depend on the proposed input; use objective = 'nearest'"
            " for a torch layer"
        )
    reasons = {
        "demand": "is reciprocal, or of a certificate; use cbf, hocbf, scbf or szcbf",
        "change": "has a sampling margin of first order; use a number or 'none'",
        "uncertainty": (
            "is uncertain; use a condition of a model, or a learned one without uncertainty"
        ),
        "alternatives": (
            "is of a maximum, of whose functions the proposed input chooses one; take a smooth"
            " function below it"
        ),
        "terms": "holds a network; use a condition of a model, or a learned one with formulas",
    }
    for (barrier, condition), constraint in zip(safety_filter.parts, qp.constraints, strict=True):
        for attribute, reason in reasons.items():
            if getattr(constraint, attribute) not in (None, ()):
                raise ConfigurationError(
                    f"the constraint {condition.name} on {barrier.name} {reason}: a torch layer"
                    " takes plain constraints only"
                )
