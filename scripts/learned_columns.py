"""What the table of an evaluation says of learning: its time, the worst identification, certificates, and notes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from agents.episodes import Row

Cell = Callable[[Row], str]

_NONE = "-"


def learned_columns(rows: Sequence[Row]) -> dict[str, Cell]:
    """The columns that the rows need, by title; none where nothing was learned."""
    columns: dict[str, Cell] = {}
    if any(row["learning"] for row in rows):
        columns["learned\nin"] = _seconds
    if any(row["learning"] and row["learning"]["repeats"] > 1 for row in rows):
        columns["worst\nident."] = _worst
    if any(row["certificate"] for row in rows):
        columns["certificate"] = _certificate
    return columns


def learned_notes(rows: Sequence[Row]) -> list[str]:
    """What has to be known of what was learned, and of certificates."""
    notes = []
    if any(row["learning"] for row in rows):
        notes.append("no proved bound for what rests on something learned; bayesian-scbf:simultaneous=P has a certificate.")
    for row in rows:
        learning, certificate = row["learning"], row["certificate"]
        if learning and learning["files"]:
            notes.append(
                f"{row['filter']} was learned before, from {learning['transitions']:,} transitions: {', '.join(learning['files'])}"
            )
        elif learning:
            each = " each" if learning["repeats"] > 1 else ""
            notes.append(f"{row['filter']} was learned from {learning['transitions']:,} transitions{each}.")
        notes += [f"{row['filter']}: {warning}" for warning in (learning["warnings"] if learning else ())]
        if certificate and certificate["note"]:
            notes.append(f"certificate of {row['filter']}: {certificate['note']}")
        if certificate and "delta" in certificate:
            notes.append(
                f"certificate of {row['filter']}: P >= (1 - delta)(h_0 - m T)/c, with probability delta = {certificate['delta']:.3g} that "
                f"the identification misses the system, shortfall m = {certificate['shortfall']:.3g}, c = {certificate['supremum']:.3g}."
            )
    return notes


def _seconds(row: Row) -> str:
    learning = row["learning"]
    return f"{learning['seconds']:.2f} s" if learning else _NONE


def _worst(row: Row) -> str:
    learning = row["learning"]
    return f"{100 * min(learning['rates']):.1f} %" if learning and learning["repeats"] > 1 else _NONE


def _certificate(row: Row) -> str:
    certificate = row["certificate"]
    if certificate is None:
        return _NONE
    return "none" if certificate["probability"] is None else f"≥ {100 * certificate['probability']:.1f} %"
