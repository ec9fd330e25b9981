"""The picture of a log shows what is in it."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from safe_envs import ConfigurationError, DecisionLog, plot_log
from safe_envs.filters.decision_log import LogColumns

COLUMNS = LogColumns.of(("x",), ("u", "rotor_speed"), ("wall",), units={"u": "m/s^2"})


def log_of(rows):
    """A log with a row (t, u nominal, u executed, h, slack, intervention, feasible) each."""
    log = DecisionLog(COLUMNS)
    for t, nominal, executed, h, slack, intervention, feasible in rows:
        cause = 0 if intervention else -1
        log.append(
            [
                *(t, 0.0, nominal, 0.0, executed, 0.0, -2.0, -np.inf, 2.0, np.inf),
                *(h, slack, intervention, feasible, cause),
            ]
        )
    return log


SAFE = [(0.1 * k, 1.0, 1.0 - 0.1 * k, 2.0 - k, 0.0, k > 2, True) for k in range(5)]
UNSAFE = [*SAFE, (0.5, 1.0, 0.2, -4.0, 1.5, True, False), (0.6, 1.0, 0.2, -4.5, 0.0, False, True)]


def spans(panel):
    return [
        [path.vertices[:3, 0][[0, 1]].tolist() for path in each.get_paths()]
        for each in panel.collections
        if isinstance(each, PolyCollection)
    ]


def test_panels_lines_and_marks():
    figure = plot_log(log_of(UNSAFE))
    panels = figure.axes
    assert [panel.get_ylabel() for panel in panels] == [
        r"$u$ [$\mathrm{m}/\mathrm{s}^{2}$]",
        "rotor speed",
        "$h$",
        "slack",
    ]
    nominal, executed, low, high = panels[0].lines
    np.testing.assert_allclose(nominal.get_ydata(), 1.0)
    np.testing.assert_allclose(executed.get_ydata(), [1, 0.9, 0.8, 0.7, 0.6, 0.2, 0.2])
    assert {*low.get_ydata(), *high.get_ydata()} == {-2.0, 2.0}
    np.testing.assert_allclose(panels[2].lines[0].get_ydata(), [2, 1, 0, -1, -2, -4, -4.5])
    np.testing.assert_allclose(panels[3].lines[0].get_ydata(), [0, 0, 0, 0, 0, 1.5, 0])
    for panel in panels:
        intervened, infeasible = spans(panel)
        np.testing.assert_allclose(intervened, [[0.3, 0.5]])
        np.testing.assert_allclose(infeasible, [[0.5, 0.6]])
        assert panel.get_xlim() == pytest.approx((0.0, 0.7))
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert {"nominal input", "infeasible", "$h$ wall, min -4.5"} <= set(texts)
    assert "1 infeasible" in figure.get_suptitle()


def test_slacks_have_a_panel_where_there_are_some():
    figure = plot_log(log_of(SAFE))
    assert [panel.get_ylabel() for panel in figure.axes][-1] == "$h$"
    assert "infeasible" not in [t.get_text() for t in figure.legends[0].get_texts()]


def test_constant_inputs_are_shown_between_their_bounds():
    figure = plot_log(log_of([(0.0, 1.0, 1.0, 2.0, 0.0, False, True)]))
    low, high = figure.axes[0].get_ylim()
    assert low < -2.0 < 2.0 < high
    low, high = figure.axes[1].get_ylim()
    assert low < 0.0 < high


def test_the_smallest_h_is_within_the_panel_whatever_else_is_logged():
    log = DecisionLog(LogColumns.of(("x",), ("u",), ("near", "far")))
    for k in range(20):
        log.append([k, 0, 0, 0, -1, 1, 0.1 + 0.01 * k, 1e6 - 4e4 * k, 0, 0, 0, 1, -1])
    low, high = plot_log(log).axes[1].get_ylim()
    assert low < 0.0 < 0.29 < high < 1.0


def test_a_file_is_drawn_between_two_times(tmp_path):
    log_of(UNSAFE).to_csv(tmp_path / "log.csv")
    out = tmp_path / "log.svg"
    figure = plot_log(tmp_path / "log.csv", out, start=0.15, end=0.4, title="cost in $")
    assert out.stat().st_size > 1000
    np.testing.assert_allclose(figure.axes[0].lines[0].get_xdata(), [0.2, 0.3, 0.4])
    assert figure.get_suptitle() == r"cost in \$"


@pytest.mark.parametrize(
    ("given", "more", "reason"),
    [
        (log_of(SAFE), {"start": 3.0}, "start = 3.0"),
        (log_of(SAFE), {"start": 0.3, "end": 0.2}, "from 0 to 0.4 s"),
        (log_of(SAFE), {"out": "log.exe"}, "FILE.png"),
        (log_of(SAFE), {"out": "none/log.png"}, "does not exist"),
        (log_of(SAFE), {"out": 3}, "no path; give FILE"),
        (5, {}, "no path"),
        (DecisionLog(COLUMNS), {}, "0 periods"),
    ],
)
def test_what_cannot_be_drawn_is_refused(tmp_path, monkeypatch, given, more, reason):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match=reason):
        plot_log(given, **more)
    assert not list(tmp_path.iterdir())


def with_barriers(rows, names=None, bounds=(-1.0, 1.0), proposed=0.0):
    """A log of one input with these values of barriers in each period."""
    names = names or [f"b{i}" for i in range(len(rows[0]))]
    log = DecisionLog(LogColumns.of(("x",), ("u",), names))
    for k, h in enumerate(rows):
        log.append([k, 0, proposed, 0, *bounds, *h, *[0] * len(h), 0, 1, -1])
    return log


def test_the_panel_says_where_it_is_cut_off():
    cut = plot_log(with_barriers([[1.0, 7.0], [2.0, 1e6]]))
    assert cut.axes[1].get_title("right") == "$h$ cut off at 2.1"
    whole = plot_log(with_barriers([[1.0, 1.0], [2.0, 2.0]]))
    assert whole.axes[1].get_title("right") == ""


@pytest.mark.parametrize(
    ("h", "u"),
    [
        ([np.nan, np.nan], 1e308),
        ([np.inf, -np.inf], -1e30),
        ([1e-320, 0.0], 1e-320),
    ],
)
def test_numbers_that_cannot_be_drawn(h, u, tmp_path):
    bounds = (0.0, 0.0) if u == 0.0 else (-1e308, 1e308)
    log = with_barriers([h, h[::-1]], proposed=u, bounds=bounds)
    plot_log(log, tmp_path / "log.pdf")
    assert (tmp_path / "log.pdf").stat().st_size > 1000


@pytest.mark.parametrize("times", [(-1e308, 1e308), (1e17, 1e17)])
def test_times_that_cannot_be_drawn(times, tmp_path):
    log = DecisionLog(LogColumns.of(("x",), ("u",), ("h",)))
    for t in times:
        log.append([t, 0, 0, 0, -1, 1, 1, 0, 0, 1, -1])
    plot_log(log, tmp_path / "log.pdf")


def test_names_that_are_no_mathematics_or_in_no_font(tmp_path):
    names = ("$\\frac{", "a\rb", "\ufeffa", "\u202e", "a\x00")
    log = DecisionLog(LogColumns(names, names, names, units={name: name for name in names}))
    log.append([0, *[0] * 15, *[-1] * 5, *[1] * 5, *[1] * 5, *[0] * 5, 0, 1, -1])
    plot_log(log, tmp_path / "log.pdf")
