"""What may be asked of a table of values."""

from __future__ import annotations

import json
from typing import Any

import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.values.tables import ValueSettings


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"knowledge": "plants"}, "did you mean 'plant'"),
        ({"leaving": "no"}, "allowed: violation, safe"),
        ({"cells": 400}, "cells = 400; give a whole number for each coordinate"),
        ({"cells": "400x100"}, "give a whole number for each coordinate"),
        ({"cells": (400.0,)}, "cells = 400.0; give a whole number from 2"),
        ({"cells": (1,)}, "cells = 1; give a whole number from 2"),
        ({"inputs": 1}, "inputs = 1; give a whole number from 2"),
        ({"memory": 0.0}, "give a number of bytes"),
        ({"memory": float("inf")}, "memory = inf is not finite"),
        ({"memory": "much"}, "memory = 'much' is not a number"),
        ({"intervals": {"v": 3.0}}, "interval of v = 3.0; give two numbers"),
        ({"intervals": {"v": (1.0, 2.0, 3.0)}}, "give two numbers"),
        ({"intervals": {"v": (1.0, float("nan"))}}, "interval of v = nan is not finite"),
        ({"specification": 3}, "specification = 3; give text"),
    ],
)
def test_what_is_not_allowed_is_explained(given: dict[str, Any], message: str):
    with pytest.raises(ConfigurationError) as error:
        ValueSettings(**given)
    assert message in str(error.value)


def test_settings_go_through_json():
    settings = ValueSettings("plant", "safe", {"v": (1, 2)}, cells=[40, 50], inputs=3)  # pyright: ignore[reportArgumentType]
    assert ValueSettings(**json.loads(json.dumps(settings.as_dict()))) == settings
    assert settings.cells == (40, 50)
