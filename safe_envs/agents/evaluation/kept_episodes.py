"""Where the results of single episodes go, besides into the statistics."""

from __future__ import annotations

from typing import Protocol

from safe_envs.agents.evaluation.rows import EpisodeResults


class EpisodeSink(Protocol):
    """Receives the results of all episodes in the order of filters, identifications, episodes."""

    def begin(self, name: str, repeat: int) -> None:
        """Go on with the episodes of another filter or identification.

        Args:
            name: of the filter.
            repeat: number of the identification.
        """

    def add(self, results: EpisodeResults) -> None:
        """Receive the episodes that follow."""


class KeptEpisodes(EpisodeSink):
    """Keeps the results in memory."""

    def __init__(self) -> None:
        self._parts: dict[tuple[str, int], list[EpisodeResults]] = {}
        self._current: list[EpisodeResults] = []

    def begin(self, name: str, repeat: int) -> None:
        """See `EpisodeSink`.

        Args:
            name: of the filter.
            repeat: number of the identification.
        """
        self._current = self._parts[name, repeat] = []

    def add(self, results: EpisodeResults) -> None:
        """See `EpisodeSink`."""
        self._current.append(results)

    def joined(self) -> dict[str, list[EpisodeResults]]:
        """Return the results for each filter and identification."""
        found: dict[str, list[EpisodeResults]] = {}
        for (name, _), parts in self._parts.items():
            found.setdefault(name, []).append(EpisodeResults.joined(parts))
        return found
