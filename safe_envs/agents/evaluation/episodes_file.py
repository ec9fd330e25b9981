"""The results of single episodes as a Parquet file."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from safe_envs.agents.evaluation.results import Evaluation
from safe_envs.atomic_io import write_atomically
from safe_envs.errors import ConfigurationError


def require_parquet() -> None:
    """Raise ConfigurationError unless pyarrow is installed: asked before a long run."""
    if find_spec("pyarrow") is None:
        raise ConfigurationError(
            'pyarrow is not installed, which writes Parquet; pip install "safe-envs[sweep]"'
        )


def write_episodes(path: Path, evaluation: Evaluation) -> None:
    """Write `Evaluation.episode_columns`, with null for NaN, whole or not at all.

    The rows are in the order of filters, identifications and episodes, whatever `num_envs` and
    `jobs` were.

    Args:
        path: of the file.
        evaluation: whose episodes are written.

    Raises:
        ConfigurationError: pyarrow is not installed, or the file cannot be written.
    """
    require_parquet()
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {
        name: pa.array(values, from_pandas=True)
        for name, values in evaluation.episode_columns().items()
    }
    write_atomically(path, lambda part: pq.write_table(pa.table(columns), part))
