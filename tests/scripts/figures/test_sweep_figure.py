from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import pytest

from safe_envs.agents.evaluation.statistics import rate_interval, repeated_interval
from safe_envs.scripts.figures import sweep
from safe_envs.scripts.figures.sweep import Layout, _rate, draw, figure_of
from tests.readable import figure_texts, unreadable

pytestmark = pytest.mark.slow

FILTERS = ("none", "scbf")
SWEPT = ("filter", "noise", "dt", "seed")


def rows_of(**values: Any) -> list[dict[str, Any]]:
    names = list(values)
    rows = [dict(zip(names, each, strict=True)) for each in itertools.product(*values.values())]
    for k, row in enumerate(rows):
        low, high = rate_interval(k % 20, 20)
        row |= {
            "safe": k % 20,
            "episodes": 20,
            "safety_rate": (k % 20) / 20,
            "ci_low": low,
            "ci_high": high,
        }
        row |= {"config": '{"title": "mine"}', "row": '{"learning": null}'}
        row |= {"error": None, "return_mean": float(k)}
    return rows


ROWS = rows_of(filter=FILTERS, noise=[0.3, 0.1, 0.2], dt=[0.1, 0.2], seed=[0, 1, 2, 3])


@pytest.mark.parametrize(
    ("given", "layout"),
    [
        ((), Layout("noise", "filter", ("dt",))),
        (("dt",), Layout("dt", "filter", ("noise",))),
        (("dt", "noise"), Layout("dt", "noise", ("filter",))),
        (("seed",), Layout("seed", "filter", ("noise", "dt"))),
        (("filter",), Layout("filter", "noise", ("dt",))),
    ],
)
def test_what_is_across_what_has_lines_and_what_has_panels(given: tuple[str, ...], layout: Layout):
    assert Layout.of(ROWS, SWEPT, *given) == layout


def test_of_seeds_alone_there_is_one_rate():
    assert Layout.of(ROWS, ("seed",)) == Layout(None, None, ())
    assert Layout.of(ROWS, ("filter", "seed")) == Layout("filter", None, ())


def test_episodes_of_several_seeds_are_put_together():
    assert _rate([]) is None
    assert _rate(ROWS[:1]) == (ROWS[0]["safety_rate"], ROWS[0]["ci_low"], ROWS[0]["ci_high"])
    assert _rate(ROWS[1:4]) == (6 / 60, *rate_interval(6, 60))


def test_the_band_of_seeds_that_learned_anew_is_over_what_they_learned_too():
    rows = [
        {**row, "row": json.dumps({"learning": {"sha256": [str(k)]}})}
        for k, row in enumerate(ROWS[1:4])
    ]
    rate, low, high = _rate(rows) or (0.0, 0.0, 0.0)
    assert (rate, low, high) == (
        6 / 60,
        *repeated_interval([1 / 20, 2 / 20, 3 / 20], rate_interval(6, 60), 0.95, (0.0, 1.0)),
    )
    # As of a file, which is the same for all of them.
    same = [{**row, "row": rows[0]["row"]} for row in rows]
    assert _rate(same) == (6 / 60, *rate_interval(6, 60))


def test_what_no_cell_has_yet_is_drawn_as_the_envs_own():
    rows = [{**row, "start": None} for row in rows_of(noise=[0.1, 0.2])]
    layout = Layout.of(rows, ("noise", "start"))
    assert layout == Layout("noise", "start", ())
    assert figure_of(rows, layout)[1] == 0


@pytest.mark.parametrize(
    ("swept", "given", "panels"),
    [
        (SWEPT, ("filter", "noise"), ("dt = 0.1", "dt = 0.2")),
        (("seed",), (), ("mine: safety rate",)),
    ],
)
def test_a_picture_of_each_kind(
    tmp_path: Path, swept: tuple[str, ...], given: tuple[str, ...], panels: tuple[str, ...]
):
    path = tmp_path / "rates.svg"
    assert draw(ROWS, swept, path, "double", *given) == f"The picture: {path}"
    text = path.read_text()
    assert all(panel in text for panel in panels)


def test_panels_without_room_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sweep, "_MOST_PANELS", 3)
    rows = rows_of(filter=FILTERS, noise=[0.3, 0.1], dt=[0.1, 0.2], start=[*"abcd"])
    swept, path = ("filter", "noise", "dt", "start"), tmp_path / "rates.svg"
    assert "without 5 of its panels" in draw(rows, swept, path, "double", "dt", "noise")
    assert "filter = none, start = c" in (text := path.read_text())
    assert "start = d" not in text


PROMISES = ("none", "promise:p=0.9", "promise:p=0.99")


@pytest.mark.parametrize(
    ("given", "layout"),
    [
        ({"env": ["one", "two"]}, Layout(None, "filter", ("env",), returns=True)),
        ({"noise": [0.1, 0.2]}, Layout("noise", "filter", ())),
    ],
)
def test_promises_at_several_p_are_compared_by_return_over_violations(given, layout):
    rows = rows_of(filter=PROMISES, seed=[0, 1], **given)
    assert Layout.of(rows, ("filter", "seed", *given)) == layout
    assert not Layout.of(rows, ("filter", "seed", *given), "filter").returns


def test_a_point_is_the_pooled_return_over_the_pooled_violations():
    rows = rows_of(filter=PROMISES, seed=[0, 1])
    figure, _ = figure_of(rows, Layout.of(rows, ("filter", "seed")), "single")
    (axes,) = figure.axes
    found = [tuple(each.lines[0].get_xydata()[0]) for each in axes.containers]
    assert found == [
        pytest.approx((1 - (one["safe"] + other["safe"]) / 40, one["return_mean"] + 0.5))
        for one, other in zip(rows[::2], rows[1::2], strict=True)
    ]
    assert axes.get_legend_handles_labels()[1] == list(PROMISES)
    assert unreadable(*figure_texts(figure)) == []
    # A cell that one panel lacks stays in the legend, which is that of the first one.
    rows = rows_of(env=["one", "two"], filter=PROMISES)[1:]
    figure, _ = figure_of(rows, Layout.of(rows, ("env", "filter")), "double")
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [*PROMISES[1:], "none"]


MANY = {
    "short": [
        "none",
        "scbf",
        "cbf",
        "rcbf",
        "srcbf",
        "hocbf:alpha=1",
        "hocbf:alpha=22",
        "promise:p=0.99",
    ],
    "long": [
        "none",
        *(f"hocbf:alpha={k},8,sampling_margin=true,a_long_name={k}" for k in range(7)),
    ],
}


@pytest.mark.parametrize(
    ("names", "swept", "size"),
    [
        ("short", ("filter",), "single"),
        ("long", ("filter", "noise"), "single"),
        ("short", ("filter", "noise", "dt"), "double"),
    ],
)
def test_eight_filters_can_be_read_and_told_apart(names: str, swept: tuple[str, ...], size: str):
    values = {"filter": MANY[names], "noise": [0.1, 0.2, 0.3], "dt": [0.1, 0.2]}
    rows = rows_of(**{name: values[name] for name in swept})
    figure, _ = figure_of(rows, Layout.of(rows, swept), size)
    assert unreadable(*figure_texts(figure)) == []
    heights = [axes.get_position().height * figure.get_figheight() for axes in figure.axes]
    assert min(heights) > 0.8
    if len(swept) > 1:
        looks = {
            (line.get_color(), str(line.get_linestyle()), line.get_marker())
            for line in figure.axes[0].get_lines()
        }
        assert len(looks) == len(MANY[names])


def test_cells_without_a_rate_leave_a_gap():
    rows = rows_of(filter=MANY["short"], noise=[0.1, 0.2, 0.3])
    for row in rows:
        if row["filter"] == "cbf" or row["noise"] == 0.2:
            row |= dict.fromkeys(("safety_rate", "ci_low", "ci_high"), math.nan)
    rows = [row for row in rows if row["filter"] != "scbf" or row["noise"] == 0.1]
    figure, _ = figure_of(rows, Layout.of(rows, ("filter", "noise")), "single")
    assert unreadable(*figure_texts(figure)) == []
