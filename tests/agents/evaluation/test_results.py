"""The result of an evaluation as text, columns, data frames and files."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation import episodes_file
from safe_envs.agents.evaluation.results import row_columns
from safe_envs.agents.evaluation.spec import RunSettings
from tests.agents.evaluation.made_up import attainable, nasty_evaluation


@pytest.fixture(scope="module")
def found():
    return measured()


def measured(**how):
    options = {"horizon": 1.0, "noise": 0.8}
    given = {"options": options, "episodes": 40, "bounds": False, **how}
    return evaluate("Scalar-v0", "random", ["none", "cbf:alpha=2"], record=how == {}, **given)


def test_text_is_a_short_table(found):
    head, _, rest = str(found).partition("\n\n")
    heading, setting = head.split("\n", 1)
    lines = rest.splitlines()
    assert heading == f"{found.title} | policy random | 40 episodes | seed 0"
    assert setting.startswith("noise sigma = 0.8, model = plant")
    assert "safe [95 %" in lines[0]
    assert [line.split()[0] for line in lines[3:5]] == ["none", "cbf:alpha=2"]
    assert len(lines) < 12
    assert max(map(len, str(found).splitlines())) <= 80
    assert repr(found) == str(found)


def test_all_forms_tell_the_setting_and_what_makes_intervals_meaningless():
    options = {"horizon": 0.1}
    plain = evaluate("DubinsDisk-v0", filters=["none", "hocbf"], options=options, episodes=3)
    fixed = replace(
        plain,
        config={**plain.config, "monitoring": "continuous"},
        is_deterministic=True,
        best=replace(attainable(0.9, 1.0), lower=None, upper=None, contradiction="it is"),
    )
    for text in (str(fixed), fixed.to_markdown(), fixed._repr_html_(), fixed.to_latex()):
        words = " ".join(text.split())
        assert "v = 0.8 (model 0.5)" in words
        assert "monitored continuously" in words
        assert "the interval has no meaning" in words
        assert "est attainable safety: withheld" in words
        assert "of the episodes start where h" not in words


def test_the_short_table_has_the_worst_identification():
    found = nasty_evaluation()
    assert "worst" in str(found)
    assert "20 episodes x 3 identifications" in str(found)
    assert "20 episodes x 3 identifications" in found.to_latex()


def test_results_of_episodes_are_those_of_the_rows(found):
    columns = found.episode_columns()
    for row in found.rows:
        here = columns["filter"] == row.filter
        each = {name: values[here] for name, values in columns.items()}
        assert each["episode"].tolist() == list(range(40))
        assert 0 < row.safe == each["safe"].sum() < 40
        assert row.return_mean == pytest.approx(each["return"].mean())
        assert row.effort_mean == pytest.approx(np.nanmean(each["effort"]))
        assert row.min_h_median == np.median(each["min_h"])
        h = found.trajectories[row.filter].barrier
        np.testing.assert_array_equal(each["length"], np.isfinite(h).sum(axis=0) - 1)
        np.testing.assert_allclose(each["min_h"], np.nanmin(h, axis=0))
        unsafe = ~each["safe"]
        first = (h <= 0).argmax(axis=0)[unsafe] * found.problem.dt
        np.testing.assert_allclose(each["first_violation"][unsafe], first)
        assert np.isnan(each["first_violation"][each["safe"]]).all()
        counted = np.where(unsafe, (h <= 0).argmax(axis=0), each["length"])
        share = each["interventions"].sum() / counted.sum()
        assert row.intervention_rate == pytest.approx(share)


def test_episodes_that_were_not_kept_are_an_error_that_says_what_to_do(found):
    without = measured(keep_episodes=False)
    assert without.rows == found.rows
    assert without.comparisons == found.comparisons
    for use in (lambda: without.episodes, without.episode_columns):
        with pytest.raises(ConfigurationError, match=r"the 80 episodes .* keep_episodes=True"):
            use()
    for name, (flags,) in without.safe.items():
        np.testing.assert_array_equal(flags.array, found.episodes[name][0].safe)


def test_episodes_are_kept_up_to_a_million_unless_it_is_said():
    assert RunSettings().keeps(1_000_000)
    assert not RunSettings().keeps(1_000_001)
    assert RunSettings(keep_episodes=True).keeps(1_000_001)
    assert not RunSettings(keep_episodes=False).keeps(1)
    word: Any = "no"
    with pytest.raises(ConfigurationError, match="keep_episodes = 'no'; give True, False or None"):
        RunSettings(keep_episodes=word)


@pytest.mark.slow
def test_the_file_is_the_same_for_every_num_envs_and_jobs(found, tmp_path):
    contents = set()
    for i, how in enumerate(({}, {"num_envs": 7}, {"jobs": 2})):
        measured(episodes_out=str(tmp_path / f"{i}.parquet"), **how)
        contents.add((tmp_path / f"{i}.parquet").read_bytes())
    assert len(contents) == 1
    table = pq.read_table(tmp_path / "0.parquet")
    columns = found.episode_columns()
    assert table.column_names == list(columns)
    assert table["return"].to_pylist() == columns["return"].tolist()
    assert table["first_violation"].null_count == columns["safe"].sum()


def test_without_pyarrow_or_pandas_errors_say_what_to_install(found, monkeypatch, tmp_path):
    monkeypatch.setattr(episodes_file, "find_spec", lambda _: None)
    with pytest.raises(ConfigurationError, match=r"pip install --editable \"\.\[sweep\]\""):
        RunSettings(episodes_out=tmp_path / "out.parquet")
    assert not (tmp_path / "out.parquet").exists()
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigurationError, match="pip install pandas"):
        found.to_frame()


def test_data_frames_have_a_row_for_each_filter_or_episode(found, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda data: data))
    columns = found.to_frame()
    assert columns["filter"].tolist() == ["none", "cbf:alpha=2"]
    assert columns["safety_rate"].tolist() == [row.safety_rate for row in found.rows]
    assert not {"curve", "learning"} & set(columns)
    assert {len(values) for values in columns.values()} == {2}
    assert len(found.to_frame(episodes=True)["return"]) == 80


def test_columns_of_data_frames_have_one_type_each(found):
    columns = row_columns(found)
    kinds = {name: values.dtype.kind for name, values in columns.items()}
    assert {"violations", "episodes", "touching", "learned_from"} <= {
        name for name, kind in kinds.items() if kind == "i"
    }
    texts = ("title", "filter", "policy", "held_word", "continuous_note", "withheld")
    assert all(isinstance(cell, str) for name in texts for cell in columns[name])
    numbers = {name for name, kind in kinds.items() if kind == "f"}
    assert {"ci_low", "held_bound", "attainable_high", "steps_per_second"} <= numbers
    assert np.isnan(columns["held_bound"]).all()
    # Also where no filter has a number, the column is one of numbers.
    bare = replace(found, rows=[replace(row, effort_mean=None) for row in found.rows])
    assert row_columns(bare)["effort_mean"].dtype.kind == "f"


def test_rows_are_found_by_name(found):
    assert found.row("none") is found.rows[0]
    with pytest.raises(KeyError):
        found.row("scbf")
