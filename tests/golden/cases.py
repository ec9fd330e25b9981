"""The golden cases: command lines of `safe-envs` and `python -m thesis` by case, small enough that
all of them take about two minutes of one processor.

`{root}` stands for the folder of the project. Each case runs in a temporary folder of its own, its
lines in order.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field


@dataclass(frozen=True)
class System:
    """An env id with what its cases need.

    Attributes:
        filter: the one of the env.
        dt: its control period in s.
        degree_one: whether its barrier has relative degree 1.
        mismatch: options that make the model differ from the plant.
        clf: whether it has a control Lyapunov function.
        start: options with which short episodes come near the edge of the safe set.
    """

    filter: str
    dt: float
    degree_one: bool
    mismatch: str
    clf: bool = False
    start: str = ""


@dataclass(frozen=True)
class Case:
    """Command lines that run one after another.

    Attributes:
        lines: `COMMAND ARGUMENTS` of safe-envs, or `thesis ARGUMENTS`; without --json.
        files: texts by name, written first.
    """

    lines: tuple[str, ...]
    files: dict[str, str] = field(default_factory=dict)

    def arguments(self, root: str) -> list[tuple[str, list[str]]]:
        """Return each line with its arguments."""
        return [(line, shlex.split(line.replace("{root}", root))) for line in self.lines]


SYSTEMS = {
    "DubinsDisk-v0": System("hocbf", 0.05, False, "--plant v=0.7 --model v=0.6"),
    "DubinsObstacle-v0": System("hocbf", 0.05, False, "--plant v=0.7 --model v=0.6"),
    "DubinsObstacles-v0": System("hocbf", 0.05, False, "--plant v=0.7 --model v=0.6"),
    "DubinsReach-v0": System("hocbf", 0.2, False, "--plant v=1.1 --model v=0.9"),
    "StochasticDubins-v0": System("scbf", 0.05, False, "--plant v=2.2 --model v=1.8"),
    "QuadrotorAltitude-v0": System("hocbf", 0.05, False, "--plant m=0.5 --model m=0.45"),
    "Quadrotor-v0": System("hocbf", 0.05, False, "--plant m=0.5 --model m=0.45"),
    "QuadrotorLimits-v0": System("hocbf", 0.05, False, "--plant m=0.5 --model m=0.45"),
    "ACC-v0": System(
        "scbf", 0.05, True, "--plant M=1700 --model f_1=6", clf=True, start=" --start 22,20,40"
    ),
    "ACCGap-v0": System(
        "scbf", 0.01, False, "--plant M=1700 --model f_1=6", clf=True, start=" --start 21,10.6"
    ),
    "Pendulum-v0": System("scbf", 0.01, True, "--plant m=1.1 --model l=0.75"),
    "CubicSDE-v0": System("scbf", 0.01, True, "--plant a=0.7 --model a=0.5", clf=True),
    "CubicSDEDisk-v0": System("scbf", 0.01, True, "--plant a=0.7 --model a=0.5"),
    "Scalar-v0": System("scbf", 0.01, True, "--noise 0.3 --model sigma=0.25"),
}

_GRID = """
fixed: {env: Scalar-v0, episodes: 20, horizon: 0.3, bounds: true}
grid: {filter: [none, scbf], noise: [0.2, 0.5]}
"""
_CELLS = """
fixed: {episodes: 10, horizon: 0.5, policy: random, seed: 4}
cells:
  - {env: DubinsDisk-v0, filter: "hocbf:alpha=2,8", plant.v: 0.9}
  - {env: CubicSDEDisk-v0, filter: srcbf, start: [0.1, 0.6], objective: nearest}
  - {env: QuadrotorLimits-v0, filter: hocbf, knowledge: plant, noise: 0.1}
"""

_TRAINED = (
    (
        "Scalar-v0",
        "ppo",
        "--set n_steps=32 --num-envs 8 --n-timesteps 512 --filter scbf --intervention-penalty 0.1",
    ),
    ("CubicSDEDisk-v0", "a2c", "--num-envs 4 --n-timesteps 200"),
    (
        "DubinsDisk-v0",
        "sac",
        "--set learning_starts=32 --num-envs 4 --n-timesteps 120 --filter hocbf --action both --horizon 2",
    ),
    (
        "Quadrotor-v0",
        "td3",
        "--set learning_starts=32 --num-envs 4 --n-timesteps 120 --filter hocbf --action proposed --horizon 2",
    ),
    (
        "QuadrotorLimits-v0",
        "ppo",
        "--set n_steps=16 --num-envs 8 --n-timesteps 256 --knowledge plant --filter hocbf --horizon 2",
    ),
    (
        "Pendulum-v0",
        "ppo-lag",
        "--set n_steps=32 --num-envs 8 --n-timesteps 512 --cost-limit 2 --horizon 1",
    ),
    (
        "CubicSDE-v0",
        "sac-lag",
        "--set learning_starts=32 --num-envs 4 --n-timesteps 120 --violation-limit 0.1 --horizon 1",
    ),
)

_ARTEFACTS = (
    *(
        "figure-3.1",
        "figure-3.2b",
        "figure-3.3",
        "example-4.2.2",
        "figure-4.1",
        "table-4.1",
        "figure-4.2",
        "figure-5.1",
    ),
    *("table-5.1", "table-5.2", "figure-5.3a", "figure-6.3", "figure-6.4", "table-6.3"),
)


def cases() -> dict[str, Case]:
    """Return all cases of commands by name, COMMAND/SUBJECT."""
    found = {"list/all": Case(("list",))}
    for env_id, system in SYSTEMS.items():
        found[f"evaluate/{env_id}"] = Case(_evaluate(env_id, system))
        found[f"rare/{env_id}"] = Case(_rare(env_id, system))
        found[f"verify/{env_id}"] = Case(_verify(env_id, system))
        found[f"identify/{env_id}"] = Case(_identify(env_id, system))
    found["evaluate/examples"] = Case(
        (
            *(
                f"evaluate --system {{root}}/examples/{name}.py:problem --episodes 5 --horizon 1 --seed 2"
                for name in ("bicycle", "cart_pole", "double_integrator")
            ),
            "evaluate Pendulum-v1 --filter-spec {root}/examples/pendulum_v1.py:spec --episodes 3 --seed 2",
        )
    )
    found["evaluate/backups"] = Case(
        tuple(
            f"evaluate {env_id} --filter backup --policy random --episodes 5 --horizon 2 --seed 2"
            for env_id in ("QuadrotorLimits-v0", "DubinsDisk-v0", "ACCGap-v0")
        )
    )
    found["evaluate/sensors"] = Case(
        (
            "evaluate Scalar-v0 --measurement default --estimator kf --episodes 20 --seed 2",
            "evaluate Pendulum-v0 --measurement default:dropout=0.2 --measurement delay=2"
            " --estimator ekf:process_noise=0.1 --filter scbf --filter scbf:measurement_error=0.01"
            " --episodes 5 --horizon 1 --seed 2",
            "evaluate DubinsReach-v0 --measurement default --sensor-noise 2 --estimator ukf"
            " --episodes 5 --horizon 2 --seed 2",
            "identify Scalar-v0 --method bayesian --measurement default --set starts=400 --seed 3"
            " --out corrected.npz",
        )
    )
    scalar = "Scalar-v0 --horizon 0.3 --noise 1.5 --start 0.8 --cells 400 --inputs 9"
    found["best/Scalar-v0"] = Case(
        (
            f"best {scalar} --episodes 200",
            f"best {scalar} --episodes 0 --leaving safe --knowledge model",
            f"evaluate {scalar.partition(' --cells')[0]} --filter promise:p=0.5 --episodes 40 --best",
        )
    )
    found["best/Pendulum-v0"] = Case(
        ("best Pendulum-v0 --horizon 0.05 --cells 30x30 --inputs 3 --episodes 20",)
    )
    found["certify/Scalar-v0"] = Case(
        (
            "certify Scalar-v0 --degree 6 --rate 0 --horizon 0.5 --out psi.json",
            "check psi.json --state 0.5",
            "certify Scalar-v0 --degree 6 --rate 0 --horizon 0.2 --policy nominal",
        )
    )
    found["export/filters"] = Case(
        (
            "export StochasticDubins-v0 --filter scbf --out dubins",
            "export QuadrotorLimits-v0 --filter hocbf --out quadrotor",
            "export Pendulum-v0 --filter hocbf --float32 --name own --out pendulum",
        )
    )
    found["render/stills"] = Case(
        (
            "render DubinsDisk-v0 --horizon 2 --start 0,0.1,0 --compare none,hocbf:alpha=2,8 --out still.png",
            "render Scalar-v0 --policy random --noise 1 --horizon 0.3 --start 0 --seed 3 --out still.png",
        )
    )
    found["leaderboard/Scalar-v0"] = Case(
        ("leaderboard Scalar-v0 --quick --episodes 5 --out board",)
    )
    found["repeats/Scalar-v0"] = Case(
        ("evaluate Scalar-v0 --filter bayesian-scbf --repeats 3 --episodes 20 --horizon 1",)
    )
    found["sweep/grid"] = Case(
        ("sweep grid.yaml --out found --jobs 1", "sweep-report found"), {"grid.yaml": _GRID}
    )
    found["sweep/cells"] = Case(
        ("sweep cells.yaml --out found --jobs 1", "sweep-report found"), {"cells.yaml": _CELLS}
    )
    for env_id, algorithm, options in _TRAINED:
        found[f"train/{env_id}-{algorithm}"] = Case(
            (
                f"train {env_id} --algo {algorithm} --out agent --eval-episodes 4 --seed 5 {options}",
                f"evaluate {env_id} --policy agent --episodes 4 --horizon 1 --seed 6",
            )
        )
    for name in _ARTEFACTS:
        found[f"thesis/{name}"] = Case(
            (f"thesis {name} --quick --episodes 5 --jobs 1 --out report",)
        )
    return found


def _evaluate(env_id: str, system: System) -> tuple[str, ...]:
    names = [
        "none",
        "hocbf",
        "ecbf",
        "scbf",
        "szcbf",
        *(["cbf", "cbf:alpha=2", "rcbf", "srcbf"] if system.degree_one else []),
    ]
    filters = " ".join(f"--filter {name}" for name in names)
    policy, objective = ("clf", "clf") if system.clf else ("nominal", "nearest")
    few = f"evaluate {env_id} --episodes 4 --horizon {60 * system.dt:g}{system.start}"
    return (
        f"evaluate {env_id} --episodes 6 --seed 3",
        f"{few} --seed 1 {filters}",
        f"{few} --seed 2 --policy random --num-envs 3 {system.mismatch}",
        f"{few} --seed 2 --policy {policy} --knowledge plant {system.mismatch}",
        f"{few} --seed 2 --objective {objective} --filter {system.filter}:sampling_margin=0.1",
        f"{few} --seed 4 --policy zero --noise 0.2 --monitoring continuous --confidence 0.9",
        f"{few} --seed 5 --refine --substeps 2 --noise 0.1",
    )


def _rare(env_id: str, system: System) -> tuple[str, ...]:
    small = f"evaluate {env_id} --rare --particles 20 --repetitions 10 --horizon {50 * system.dt:g}{system.start}"
    return (
        f"{small} --seed 1 --noise 0.2",
        f"{small} --seed 2 --noise 0.1 --monitoring continuous --policy zero --filter {system.filter}",
    )


def _verify(env_id: str, system: System) -> tuple[str, ...]:
    options = f"--horizon {10 * system.dt:g} --episodes 4 --seed 3"
    lines = (
        f"verify {env_id} --no-simulate {options}",
        f"verify {env_id} --no-simulate --noise 0.1 --knowledge plant --filter scbf {options}",
    )
    simulated = env_id not in (
        "DubinsObstacles-v0",
        "CubicSDEDisk-v0",
        "Pendulum-v0",
        "QuadrotorLimits-v0",
    )
    return (*lines, f"verify {env_id} --simulate {options}") if simulated else lines


def _identify(env_id: str, system: System) -> tuple[str, ...]:
    noiseless = "--noise 0"
    forms = ("confidence", "simultaneous") if system.degree_one else ()
    bayesian = " ".join(
        f"--filter bayesian-scbf{form}" for form in ("", *(f":{name}=0.9" for name in forms))
    )
    few = f"--episodes 4 --horizon {40 * system.dt:g}{system.start} --seed 8"
    return (
        f"identify {env_id} --method learned-hocbf --set states=60 --set epochs=3 --seed 1 --out residual.npz {noiseless}",
        f"evaluate {env_id} --filter learned-hocbf:level=0.9 --learned residual.npz {noiseless} {few}",
        f"identify {env_id} --method ddscbf --set points=20 --set repetitions=200 --set way=direct --seed 2 --out noise.npz",
        f"identify {env_id} --method ddscbf --set points=20 --set repetitions=100 --set way=network --seed 2 --out network.npz --noise 0.3",
        f"evaluate {env_id} --filter ddscbf --filter ddscbf:margin=0.1 --learned noise.npz {few}",
        f"identify {env_id} --method bayesian --set starts=40 --set repetitions=5 --set degree=1 --seed 3 --out system.npz --noise 0.2",
        f"evaluate {env_id} {bayesian} --learned system.npz --noise 0.2 {few}",
    )
