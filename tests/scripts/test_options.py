"""From the text of options to arguments."""

from __future__ import annotations

import pytest

from safe_envs import ConfigurationError
from scripts import options


def test_what_is_not_given_stays_none():
    assert options.read_noise(None) is options.read_start(None) is options.read_box([]) is options.parameters("--plant", []) is None


def test_texts_become_numbers():
    assert options.read_noise("0.2") == 0.2
    assert options.read_noise("0.1,.2,0") == [0.1, 0.2, 0.0]
    assert options.read_start("-1,2e1,.5") == [-1.0, 20.0, 0.5]
    assert options.read_start("inward") == "inward"
    assert options.read_box(["-1,2"]) == [-1.0, 2.0]
    assert options.read_box(["-1,2", "0,3"]) == [[-1.0, 2.0], [0.0, 3.0]]
    assert options.parameters("--plant", ["v=.8", "m=-2"]) == {"v": 0.8, "m": -2}
    assert options.parameters("--barrier", ["kind=round", "power=3", "D=3.0"], words=True) == {"kind": "round", "power": 3, "D": 3.0}
    assert isinstance(options.parameters("--barrier", ["power=3"])["power"], int)


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (lambda: options.read_noise("a"), "--noise 'a'"),
        (lambda: options.read_noise(""), "--noise ''"),
        (lambda: options.read_start("1,b"), "--start '1,b'"),
        (lambda: options.read_box(["1"]), "--box '1' has 1 numbers; give LO,HI"),
        (lambda: options.read_box(["1,2,3"]), "--box '1,2,3' has 3 numbers"),
        (lambda: options.read_box(["a,b"]), "--box 'a,b'"),
        (lambda: options.parameters("--plant", ["v"]), "--plant 'v' is not of this form; give NAME=VALUE"),
        (lambda: options.parameters("--plant", ["=1"]), "NAME=VALUE"),
        (lambda: options.parameters("--plant", ["v="]), "NAME=VALUE"),
        (lambda: options.parameters("--plant", ["v=1", "v=2"]), "comes twice"),
        (lambda: options.parameters("--model", ["v=fast"]), "'fast' is not a number"),
    ],
)
def test_texts_of_another_form_are_named(read, message):
    with pytest.raises(ConfigurationError, match=message):
        read()
