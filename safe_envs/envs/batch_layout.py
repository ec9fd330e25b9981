"""What the numbers and places in the arrays of a compiled batch mean: constants of its kernels."""

# What happened in a step.
DONE = 0
BAD_ACTION = 1
UNDEFINED_FILTER = 2
NO_START = 3
NOT_FINITE = 4

PERIODS = 8
"""Control periods of noise that are drawn at once. With a multiple of 4, whole blocks are."""

STEPS = 0
PERIOD = 1
COST = 0
H_MIN = 1
EPISODE_COST = 2
BARRIERS = 3
TERMINATED = 0
TRUNCATED = 1
ENDED = 2
VIOLATION = 3
INTERVENTION = 4
ACTIVE = 5
FEASIBLE = 6
INTERVENTIONS = 0
INFEASIBLE = 1
ACTIVE_BARRIER = 2
