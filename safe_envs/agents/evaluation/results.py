"""The result of an evaluation, as texts, tables and data frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from safe_envs.agents.evaluation.evaluation_data import EvaluationData
from safe_envs.agents.evaluation.evaluation_table import evaluation_table
from safe_envs.agents.evaluation.frames import frame_of, row_columns
from safe_envs.agents.evaluation.html_table import html_table
from safe_envs.agents.evaluation.latex_table import latex_table
from safe_envs.agents.evaluation.setting_text import setting_lines
from safe_envs.text_lines import visible, wrapped
from safe_envs.text_tables import markdown_of, plain_markdown, text_of

_WIDTH = 80
"""Of texts, in characters."""


@dataclass(frozen=True, repr=False)
class Evaluation(EvaluationData):
    """The result of `evaluate`. `print` and notebooks show it as a table."""

    def to_frame(self, episodes: bool = False) -> Any:
        """Return a pandas DataFrame with a row for each filter, or for each episode.

        Args:
            episodes: whether to return the columns of `episode_columns`.

        Raises:
            ConfigurationError: pandas is not installed, or the episodes were not kept: see
                `episodes`.
        """
        return frame_of(self.episode_columns() if episodes else row_columns(self))

    def to_latex(self) -> str:
        """Return the table and the comparisons for a paper, in LaTeX with booktabs."""
        return latex_table(self)

    def to_markdown(self) -> str:
        """Return the setting and the table in Markdown, in parts that fit a page."""
        table = evaluation_table(self)
        tables = [markdown_of(each) for each in table.arranged(_WIDTH)]
        settings = map(plain_markdown, setting_lines(self))
        return "\n\n".join([*settings, tables[0], *table.facts, *tables[1:]])

    def __str__(self) -> str:
        table = evaluation_table(self).short()
        tables = map(text_of, table.arranged(_WIDTH))
        lines = [visible(f"{self.title} | {self.about}", keep="")]
        lines += [part for line in setting_lines(self) for part in wrapped(line, _WIDTH)]
        return "\n\n".join(["\n".join(lines), *tables, *table.facts])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_table(self)
