"""How the help of a command groups its options, and the examples at its end."""

from __future__ import annotations

PANELS: dict[str, str] = {
    "What": (
        "system filter-spec policy trust algo method all against data state degree held rate"
        " x lines backend address"
    ),
    "Time, start and bounds": "dt substeps horizon start box rate-limit barrier",
    "Filters": "filter knowledge objective learned estimator belief observe",
    "Noise and mismatch": (
        "noise plant model delay model-delay slew-limit measurement sensor-noise"
    ),
    "Training": (
        "n-timesteps set action intervention-penalty promise-curriculum curriculum-part cost-limit"
        " violation-limit eval-freq eval-episodes resume train"
    ),
    "Tables and proofs": "best closed-loop bounds leaving cells inputs table spec check prices arb",
    "Statistics": (
        "episodes attained seed seeds repeats confidence refine monitoring rare particles"
        " repetitions simulate states"
    ),
    "Speed": "num-envs jobs engine threads quick seconds",
    "Output": (
        "out folder json latex episodes-out timing plot size pictures markdown page worst"
        " tensorboard compare float32 name clear quiet"
    ),
    "Other": "version install-completion show-completion help",
}
"""The options of each group, in the order of the help; an option means the same in all commands."""

_PANEL_OF = {option: panel for panel, options in PANELS.items() for option in options.split()}

EXAMPLES: dict[str, tuple[str, ...]] = {
    "evaluate": (
        "safe-envs evaluate StochasticDubins-v0",
        "safe-envs evaluate Scalar-v0 --filter none --filter scbf --episodes 10000",
        "safe-envs evaluate DubinsDisk-v0 --noise 0.2 --plant v=1.2 --plot out.pdf",
        "safe-envs evaluate Pendulum-v0 --policy my_policy.py:Policy --json out.json",
        "safe-envs evaluate --system my_system.py:problem --monitoring continuous",
        "safe-envs evaluate Pendulum-v0 --measurement default --estimator ekf",
    ),
    "identify": (
        "safe-envs identify Scalar-v0 --method bayesian --out learned.npz",
        "safe-envs identify CubicSDE-v0 --method ddscbf --set points=400 --out c.npz",
    ),
    "train": (
        "safe-envs train Pendulum-v0 --algo ppo --filter hocbf --out ppo",
        "safe-envs train Pendulum-v0 --algo sac --n-timesteps 50000 --out sac",
        "safe-envs train Pendulum-v0 --algo ppo-lag --violation-limit 0.01 --out lag",
        "safe-envs train Pendulum-v0 --algo ppo --filter hocbf --out ppo --resume",
    ),
    "leaderboard": (
        "safe-envs leaderboard Pendulum-v0 --out board --quick",
        "safe-envs leaderboard Pendulum-v0 --out board --pictures pictures --markdown",
    ),
    "study": ("safe-envs study filters-in-training Pendulum-v0 --out study --quick",),
    "best": (
        "safe-envs best StochasticDubins-v0",
        "safe-envs best Scalar-v0 --cells 2000 --check --plot value.png",
    ),
    "verify": (
        "safe-envs verify StochasticDubins-v0",
        "safe-envs verify Scalar-v0 --filter scbf --no-simulate --json verified.json",
    ),
    "certify": (
        "safe-envs certify Scalar-v0 --out certificate.json",
        "safe-envs certify CubicSDE-v0 --policy nominal --degree 6",
    ),
    "check": ("safe-envs check certificate.json --state 0.5",),
    "frontier": (
        "safe-envs frontier Scalar-v0",
        "safe-envs frontier Scalar-v0 --filter promise:p=0.9 --plot frontier.pdf",
    ),
    "export": (
        "safe-envs export StochasticDubins-v0 --out filter",
        "safe-envs export Pendulum-v0 --filter hocbf --float32 --compare --out filter",
    ),
    "render": (
        "safe-envs render DubinsDisk-v0 --out episode.gif",
        "safe-envs render StochasticDubins-v0 --compare none,hocbf,scbf --out three.mp4",
    ),
    "sweep": ("safe-envs sweep sweep.yaml --out found --jobs 4",),
    "sweep-report": ("safe-envs sweep-report found --x noise --lines filter",),
    "list": ("safe-envs list", "safe-envs list --json -"),
    "doctor": ("safe-envs doctor",),
    "cache": ("safe-envs cache", "safe-envs cache --clear"),
    "demo": ("safe-envs demo --folder demo-results",),
}
"""Command lines at the end of the help of each command, of at most 78 characters."""


def panel_of(option: str) -> str | None:
    """Return the group of an option such as `--episodes`; None if it has none."""
    return _PANEL_OF.get(option.lstrip("-"))
