"""A constrained Markov decision process of three states, whose best policy has to toss a coin.

A driver is on the road, on ice or in the ditch. Bold driving pays more; on ice it costs 1 and leads
into the ditch every second time. After every step the episode ends with probability 1/4, so that
returns and costs of whole episodes are those with a discount of 3/4.

The road asks for boldness and the ditch for care under any multiplier near the best one. With care
on ice as well the return is 32/7 and the cost 0; with boldness there it is 448/53 and 96/53. All
between them is reached by tossing a coin on ice, and the best return at a cost of d from 0 to 96/53
is 32/7 + 15/7 d: 15/7 is the slope between the two, and the best multiplier.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import torch
from scipy.optimize import linprog
from scipy.special import ndtri
from stable_baselines3 import SAC

GOES_ON = 0.75
ROAD, ICE, DITCH = range(3)
CAREFUL, BOLD = range(2)

# Indices: state, action and, of the moves, the next state.
MOVES = np.array(
    [
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        [[1.0, 0.0, 0.0], [0.0, 0.5, 0.5]],
        [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    ]
)
REWARDS = np.array([[-1.0, 2.0], [0.0, 3.0], [0.0, 1.0]])
COSTS = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
START = np.array([1.0, 0.0, 0.0])


class IcyRoad(gym.Env):
    """The process, with a continuous action a: bold with probability (1 + a)/2.

    So the values of actions are linear, and a policy of random actions is worth what that of their
    means is. Observations are unit vectors.
    """

    observation_space = gym.spaces.Box(0.0, 1.0, (3,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._state = ROAD
        return np.eye(3, dtype=np.float32)[ROAD], {"cost": 0.0}

    def step(self, action):
        coin, ends, lot = self.np_random.random(3)
        state, bold = self._state, int(2.0 * coin - 1.0 < action[0])
        self._state = int(np.searchsorted(MOVES[state, bold].cumsum(), lot, side="right"))
        observation = np.eye(3, dtype=np.float32)[self._state]
        info = {"cost": float(COSTS[state, bold])}
        return observation, float(REWARDS[state, bold]), bool(ends > GOES_ON), False, info


def best(limit):
    """Solve the linear program over occupation measures x(s, a), expected visits of an episode.

    Returns:
        The return, the probability of boldness in each state (0 where it never is), and the
        multiplier.

    Source: Altman, "Constrained Markov Decision Processes", 1999, chapter 3.
    """
    balance = np.eye(3)[:, None, :] - GOES_ON * MOVES
    found = linprog(
        -REWARDS.ravel(),
        A_ub=[COSTS.ravel()],
        b_ub=[limit],
        A_eq=balance.reshape(6, 3).T,
        b_eq=START,
    )
    visits = found.x.reshape(3, 2)
    bold = visits[:, BOLD] / np.maximum(visits.sum(axis=1), 1e-12)
    return -found.fun, bold, -found.ineqlin.marginals[0]


def value_of(bold):
    """Return the expected return and cost of an episode of a policy.

    Args:
        bold: its probability of boldness in each state.
    """
    policy = np.stack([1.0 - np.asarray(bold), bold], axis=1)
    moves = (policy[:, :, None] * MOVES).sum(axis=1)
    visits = np.linalg.solve(np.eye(3) - GOES_ON * moves.T, START)[:, None] * policy
    return (visits * REWARDS).sum(), (visits * COSTS).sum()


def boldness(model):
    """Return the probability of boldness in each state of a model, which acts at random."""
    states = torch.eye(3)
    # The mean of a function of a normal number, over many of its quantiles.
    normal = ndtri((np.arange(1000) + 0.5) / 1000)
    with torch.no_grad():
        if isinstance(model, SAC):
            mean, log_std, _ = model.actor.get_action_dist_params(states)
            actions = np.tanh(mean.numpy() + log_std.exp().numpy() * normal)
        else:
            found = model.policy.get_distribution(states).distribution
            actions = np.clip(found.mean.numpy() + found.stddev.numpy() * normal, -1.0, 1.0)
    return 0.5 + 0.5 * actions.mean(axis=1)
