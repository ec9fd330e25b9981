"""From the text of options to arguments."""

from __future__ import annotations

from pathlib import Path

import pytest

from safe_envs import ConfigurationError
from safe_envs.scripts.options import text_options


def test_texts_become_numbers():
    assert text_options.read_noise("0.2") == 0.2
    assert text_options.read_noise("0.1,.2,0") == [0.1, 0.2, 0.0]
    assert text_options.read_start("-1,2e1,.5") == [-1.0, 20.0, 0.5]
    assert text_options.read_start("inward") == "inward"
    assert text_options.read_box(["-1,2"]) == [-1.0, 2.0]
    assert text_options.read_box(["-1,2", "0,3"]) == [[-1.0, 2.0], [0.0, 3.0]]
    assert text_options.parameters("--plant", ["v=.8", "m=-2"]) == {"v": 0.8, "m": -2}
    assert text_options.parameters("--barrier", ["kind=round", "power=3", "D=3.0"], words=True) == {
        "kind": "round",
        "power": 3,
        "D": 3.0,
    }
    assert isinstance(text_options.parameters("--barrier", ["power=3"])["power"], int)


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (lambda: text_options.read_noise("a"), "--noise 'a'"),
        (lambda: text_options.read_noise(""), "--noise ''"),
        (lambda: text_options.read_start("1,b"), "--start '1,b'"),
        (lambda: text_options.read_box(["1"]), "--box '1' has 1 numbers; give LO,HI"),
        (lambda: text_options.read_box(["1,2,3"]), "--box '1,2,3' has 3 numbers"),
        (lambda: text_options.read_box(["a,b"]), "--box 'a,b'"),
        (
            lambda: text_options.parameters("--plant", ["v"]),
            "--plant 'v' is not of this form; give NAME=VALUE",
        ),
        (lambda: text_options.parameters("--plant", ["=1"]), "NAME=VALUE"),
        (lambda: text_options.parameters("--plant", ["v="]), "NAME=VALUE"),
        (lambda: text_options.parameters("--plant", ["v=1", "v=2"]), "comes twice"),
        (lambda: text_options.parameters("--model", ["v=fast"]), "'fast' is not a number"),
    ],
)
def test_texts_of_another_form_are_named(read, message):
    with pytest.raises(ConfigurationError, match=message):
        read()


def test_outputs_are_files_of_their_own(tmp_path):
    out, json, plot = tmp_path / "a.npz", tmp_path / "a.json", tmp_path / "a.png"
    text_options.require_outputs(json, plot, out=out, inputs=[("--data", tmp_path / "data.npz")])
    text_options.require_outputs(None, None)
    (tmp_path / "link.npz").symlink_to(out)
    for json_file, inputs in (
        (out, []),
        (tmp_path / "." / "a.npz", []),
        (tmp_path / "link.npz", []),
        (json, [("--data", json)]),
    ):
        with pytest.raises(ConfigurationError, match="would overwrite the file of --"):
            text_options.require_outputs(json_file, plot, out=out, inputs=inputs)


def test_the_files_that_a_simulation_reads():
    filters = ["scbf", "ddscbf:file=a+b.npz:margin=1+cbf:alpha=1", "bayesian-scbf:file=c.npz+cbf"]
    found = list(
        text_options.inputs_of(
            "my.py:problem", "ppo.zip", filters, [Path("d.npz")], "here/spec.py:view"
        )
    )
    assert {("--policy", Path("ppo.zip")), ("--learned", Path("d.npz"))} < set(found)
    assert {("--system", Path("my.py")), ("--filter-spec", Path("here/spec.py"))} < set(found)
    assert {Path("a+b.npz"), Path("c.npz")} <= {
        path for option, path in found if option == "--filter"
    }
    assert not list(text_options.inputs_of(None, "nominal", ["none", "hocbf:p=1,2"]))
    assert not list(text_options.inputs_of("my.module:problem", filter_spec="my.module:view"))
