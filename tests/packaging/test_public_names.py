"""Public names of packages, some of which are imported when they are first used."""

from __future__ import annotations

from importlib import import_module

import pytest


@pytest.mark.parametrize(
    "name", ["safe_envs", "safe_envs.agents", "safe_envs.testing", "safe_envs.wrappers"]
)
def test_public_names_resolve_and_others_are_attribute_errors(name: str):
    package = import_module(name)
    for public in package.__all__:
        assert getattr(package, public) is not None, public
    assert len(set(package.__all__)) == len(package.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = package.no_such_name
