"""To be filled."""

from __future__ import annotations

from scripts.reproduce.artefact import Artefact

ARTEFACTS: tuple[Artefact, ...] = ()
