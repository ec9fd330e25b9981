"""Filters that see by noisy sensors: a vehicle with range and bearing, a car with a radar.

A Dubins vehicle knows its own place from a positioning system and a compass, and the obstacle by
its range and its bearing from the heading. One range and one bearing leave the vehicle's own place
open: turned around the obstacle, it would measure the same. So all five numbers are needed for the
five states. A car in adaptive cruise control has a radar for the gap and the relative speed to its
lead.

Each filter is shown at the true state, at the estimate of an extended or unscented Kalman filter
as if that were true (certainty equivalence), and with the belief of the estimator, on the same
noise of the plant.

    python examples/range_bearing.py
"""

from __future__ import annotations

from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.evaluate import Evaluation

RADAR = [
    "x:noise=0.1",
    "y:noise=0.1",
    "theta:noise=0.1",
    "range=sqrt((x_o - x)**2 + (y_o - y)**2):noise=0.3",
    "bearing=atan2(y_o - y, x_o - x) - theta:noise=0.1",
]


def vehicle(episodes: int = 300) -> Evaluation:
    """Return the safety of a vehicle that passes a moving obstacle."""
    return evaluate(
        "safe_envs/DubinsReach-v0",
        filters=["szcbf"],
        options={"measurement": RADAR, "start": "spread"},
        estimator="ukf",
        episodes=episodes,
        bounds=False,
    )


def car(episodes: int = 300) -> Evaluation:
    """Return the safety of a car behind a slower one, from a short gap."""
    radar = ["own_speed:noise=0.5", "relative_speed:noise=1", "gap:noise=4"]
    return evaluate(
        "safe_envs/ACC-v0",
        filters=["scbf"],
        options={"measurement": radar, "start": (22.0, 20.0, 50.0), "horizon": 20.0},
        estimator="ekf",
        episodes=episodes,
        bounds=False,
    )


def main() -> None:
    """Print safety rates with intervals, and how honest the estimators are."""
    for title, found in (("range and bearing", vehicle()), ("gap and relative speed", car())):
        print(f"{title}: {found.title}, {found.about}")
        for row in found.rows:
            rate, low, high = (100 * x for x in (row.safety_rate, row.ci_low, row.ci_high))
            seen = row.estimation
            honest = ""
            if seen is not None and seen.nees is not None:
                honest = f", NEES {seen.nees.mean:.2f} (expected {seen.nees.expected:.2f})"
            print(f"  {row.filter:20} safe {rate:.1f} % [{low:.1f}, {high:.1f}]{honest}")


if __name__ == "__main__":
    main()
