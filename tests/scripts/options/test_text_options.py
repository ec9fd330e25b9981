"""From the text of options to arguments."""

from __future__ import annotations

from pathlib import Path

import pytest

from safe_envs import ConfigurationError
from safe_envs.scripts.options import text_options


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
    assert not list(text_options.inputs_of(None, "nominal", ["none", "hocbf:alpha=1,2"]))
    assert not list(text_options.inputs_of("my.module:problem", filter_spec="my.module:view"))


def test_matplotlib_writes_every_format_that_is_allowed():
    from matplotlib.backend_bases import FigureCanvasBase

    assert set(text_options.PLOT_FORMATS) <= set(FigureCanvasBase.get_supported_filetypes())
