"""Pictures of results, for notebooks and papers.

Each function returns a figure that a notebook shows, and writes it to a file if one is given. The
commands draw with the same functions. Importing this module imports Matplotlib; `import safe_envs`
does not.
"""

from safe_envs.scripts.figures.best import plot_attainable
from safe_envs.scripts.figures.evaluation import plot_evaluation
from safe_envs.scripts.figures.log import plot_log
from safe_envs.scripts.figures.verify import plot_verification

__all__ = [
    "plot_attainable",
    "plot_evaluation",
    "plot_log",
    "plot_verification",
]
