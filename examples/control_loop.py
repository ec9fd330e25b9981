"""A filter in a 100 Hz control loop: a differential-drive robot among people, and a closing gate.

python examples/control_loop.py

The robot, the people and the gate are simulated. In your loop, measurements take their place.
"""

import gc
import time

import numpy as np
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, DecisionLog, SafetyFilter, plot_log
from safe_envs.problem.signals import TIME

PERIOD = 0.01
AHEAD, BODY, PERSON = 0.2, 0.25, 0.3  # of the look-ahead point, and radii, in m
TRACK, GYRATION = 0.4, 0.17  # distance of the wheels and radius of gyration in m
CLEARANCE = AHEAD + BODY  # of the look-ahead point, so that all of the body is clear
GOAL = np.array([7.0, 0.2])

x, y, theta, v, omega, mass = sp.symbols("x y theta v omega mass", real=True)
left, right = sp.symbols("F_left F_right", real=True)
people = [sp.symbols(f"x_{i} y_{i} v_x_{i} v_y_{i}", real=True) for i in (1, 2)]

robot = ControlAffineSDE.from_rate(
    states=(x, y, theta, v, omega),
    inputs=(left, right),
    rate=[
        v * sp.cos(theta),
        v * sp.sin(theta),
        omega,
        (left + right) / mass,
        (right - left) * TRACK / (2 * mass * GYRATION**2),
    ],
    parameters={mass: 10.0},
    # What is measured at each call, with its rate: a person goes on at the same speed.
    signals={s: rate for a, b, c, d in people for s, rate in ((a, c), (b, d), (c, 0), (d, 0))},
)
# A point ahead of the axle can be pushed in any direction at once; the axle itself cannot.
ahead_x, ahead_y = x + AHEAD * sp.cos(theta), y + AHEAD * sp.sin(theta)
gate = 1.8 - 0.5 * (1 + sp.tanh(TIME - 5))  # comes down from 1.8 m to 0.8 m around t = 5 s
barriers = [
    *(
        Barrier((ahead_x - a) ** 2 + (ahead_y - b) ** 2 - (CLEARANCE + PERSON) ** 2, f"person {i}")
        for i, (a, b, _, _) in enumerate(people, 1)
    ),
    Barrier(gate - CLEARANCE - ahead_y, "gate"),
]
rate = sp.lambdify(
    (robot.states, robot.inputs, mass),
    list(robot.drift + robot.input_matrix * sp.Matrix(robot.inputs)),
)
UNITS = {x: "m", y: "m", theta: "rad", v: "m/s", omega: "rad/s", left: "N", right: "N"}


def measure(t: float) -> dict[str, float]:
    """Return positions and speeds of the people, who cross the way."""
    seen = ((2.5, 1.6, 0.0, -0.5), (6.5, -0.7, -0.5, 0.0))
    return {
        str(symbol): float(value)
        for symbols, (a, b, c, d) in zip(people, seen, strict=True)
        for symbol, value in zip(symbols, (a + c * t, b + d * t, c, d), strict=True)
    }


def propose(state: np.ndarray) -> np.ndarray:
    """Drive towards the goal, as if there were nobody."""
    way = GOAL - state[:2]
    slow = min(1.0, np.hypot(*way))
    turn = np.arctan2(way[1], way[0]) - state[2]
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    push = 10.0 * (slow * np.cos(turn) - state[3])
    twist = 10.0 * (2.0 * slow * turn - state[4]) * GYRATION**2 / TRACK * 4.0
    return np.array([push - twist, push + twist])


def move(state: np.ndarray, force: np.ndarray, weight: float) -> np.ndarray:
    """Simulate one period, with the forces held."""
    for _ in range(10):
        state = state + 0.1 * PERIOD * np.array(rate(state, force, weight))
    return state


def run(gains: str = "3,3", seconds: float = 11.0) -> tuple[DecisionLog, np.ndarray]:
    """Run the loop; return its log, and how long each decision took in s."""
    safety_filter = SafetyFilter(
        robot, barriers, f"hocbf:alpha={gains}", input_bounds=(-20.0, 20.0), adjustable=("mass",)
    )
    log = DecisionLog.for_filter(safety_filter, UNITS)
    state, latency = np.zeros(5), []
    gc.collect()
    gc.freeze()  # What was made up to here is not looked through again.
    for k in range(round(seconds / PERIOD)):
        t = k * PERIOD
        measured = measure(t) | {"mass": 14.0 if t >= 3.0 else 10.0}  # it takes up a load
        limit = 20.0 if t < 6.0 else 12.0  # the battery runs low
        proposed = propose(state)
        begun = time.perf_counter()
        decision = safety_filter.filter(
            state, proposed, input_bounds=(-limit, limit), parameters=measured, t=t
        )
        latency.append(time.perf_counter() - begun)
        log.add(t, state, decision, input_bounds=(-limit, limit), parameters=measured)
        state = move(state, decision.action, measured["mass"])  # yours: send it, sleep until t + dt
    gc.unfreeze()
    return log, np.array(latency)


if __name__ == "__main__":
    log, latency = run()
    log.to_csv("control_loop.csv")
    plot_log("control_loop.csv", "control_loop.png")
    print(log)
    print(f"a decision took {1e6 * np.median(latency):.0f} us, {1e6 * latency.max():.0f} at worst")
