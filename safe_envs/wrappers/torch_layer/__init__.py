"""A safety filter as a layer of a torch network, through which gradients pass.

The action is the one that `safe_envs.wrappers.SafetyFilter` returns. What is differentiated is the
formula that gives it near a state: the constraints that bind are equations there, the inputs at
their bounds are constants, and of the inputs that are left those nearest to the proposal
solve a linear system. So the derivative is exact, and of any order, where the active set does not
change. At a kink it is that of one side.
"""

from safe_envs.wrappers.torch_layer.layer import TorchFilter, TorchResult

__all__ = ["TorchFilter", "TorchResult"]
