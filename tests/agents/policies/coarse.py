"""Tables that are computed in a moment."""

from __future__ import annotations

from typing import Any

from safe_envs.values.tables import ValueSettings

SHORT: dict[str, Any] = {"horizon": 0.3}


def coarse(**given: Any) -> ValueSettings:
    """Settings of a coarse table of the env Scalar."""
    return ValueSettings(**{"knowledge": "plant", "cells": (400,), "inputs": 9, **given})


COARSE = coarse()
