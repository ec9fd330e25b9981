"""The `safe-envs` command."""

from __future__ import annotations

from safe_envs.scripts.benchmark import benchmark
from safe_envs.scripts.best import best
from safe_envs.scripts.certify import certify
from safe_envs.scripts.check import check
from safe_envs.scripts.demo import demo
from safe_envs.scripts.doctor import doctor
from safe_envs.scripts.evaluate import evaluate
from safe_envs.scripts.export import export
from safe_envs.scripts.frontier import frontier
from safe_envs.scripts.identify import identify
from safe_envs.scripts.leaderboard import leaderboard
from safe_envs.scripts.listing import list_envs
from safe_envs.scripts.options.app import make_app, run_app
from safe_envs.scripts.render import render
from safe_envs.scripts.reproduce.command import reproduce
from safe_envs.scripts.study import study
from safe_envs.scripts.sweep import sweep
from safe_envs.scripts.sweep_report import sweep_report
from safe_envs.scripts.train import train
from safe_envs.scripts.verify import verify

app = make_app(
    {
        "evaluate": evaluate,
        "identify": identify,
        "train": train,
        "leaderboard": leaderboard,
        "study": study,
        "best": best,
        "verify": verify,
        "certify": certify,
        "check": check,
        "frontier": frontier,
        "export": export,
        "render": render,
        "reproduce": reproduce,
        "sweep": sweep,
        "sweep-report": sweep_report,
        "list": list_envs,
        "doctor": doctor,
        "demo": demo,
        "benchmark": benchmark,
    }
)


def main() -> None:
    """Run the command line."""
    run_app(app)


if __name__ == "__main__":
    main()
