"""Thesis Sec. 4.3.2: a Dubins vehicle with noise in a disk, under SCBF and SZCBF (Figures 4.2 and 4.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from agents.episodes import episode_seed, run_episodes
from agents.evaluation import Evaluation, evaluate
from agents.nominal import ZeroController
from agents.problems import load_problem
from safe_envs.barrier import Barrier
from safe_envs.calculus import generator
from safe_envs.problem import SafetyProblem
from safe_envs.sde import ControlAffineSDE
from safe_envs.vector import SafeVectorEnv
from scripts.figure import COLORS, QUIET, UNSAFE, add_legend
from scripts.reproduce.artefact import Artefact, Claim, Number, Outcome, Sample
from wrappers import SCBF, AffineConstraint, Condition, SafetyFilterVectorWrapper
from wrappers.bounds import theorem_4_2_10_printed, union_bound
from wrappers.formulas import Formulas

DUBINS = "safe_envs/StochasticDubins-v0"
RADIUS = 3.0
"""Of the disk, in m."""
BOX = (-10.0, 10.0)
"""Of the turn rate, in rad/s."""
STEP = 0.05
"""Control period, in s."""
HORIZONS = (3.0, 5.0, 10.0)
"""In s; one run to the last gives all."""
HORIZON = 5.0
"""Of the numbers, in s."""
ALPHAS = {"SZCBF": (1.0, 1.0), "SZCBF .5": (0.5, 0.5)}
"""Rates of the zeroing form, in 1/s."""
FILTERS = {"SCBF": "scbf", **{name: f"szcbf:alphas={a},{b}" for name, (a, b) in ALPHAS.items()}}
STARTS = {"inward": "starts with A h > 0", "uniform": "all starts"}
NOISES = (0.0, 0.05, 0.1, 0.15, 0.2)
"""sigma_1 = sigma_2 of the numbers, in m/sqrt(s)."""
BETWEEN = (0.025, 0.075, 0.125, 0.175)
"""Further ones of the curve."""
EPISODES = 1000
POINTS = 10
EPISODES_OF_POINT = 500
NOISE = 0.2
"""Of Figure 4.3, in m/sqrt(s)."""
_COLOR = dict(zip(FILTERS, COLORS, strict=False))
_LABEL = {"SCBF": "SCBF", "SZCBF": r"SZCBF, $\alpha$ = 1, 1", "SZCBF .5": r"SZCBF, $\alpha$ = .5, .5"}
Row = Mapping[str, Any]


@dataclass(frozen=True)
class PrintedSZCBF(Condition):
    """h_1 = A h + alpha_1 h, h_2 = A h_1 + alpha_2 h >= 0, as it is printed: with h in place of h_1 in the second term."""

    alphas: tuple[float, float] = (1.0, 1.0)
    name = "printed-szcbf"
    stochastic = True

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """The row by hand."""
        h = barrier.expression
        first = generator(model, h) + self.alphas[0] * h
        return AffineConstraint.after(model, (h, first), generator(model, first) + self.alphas[1] * h)

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> PrintedSZCBF:
        """With two rates."""
        return cls((gains[0], gains[1]))


def dubins_problem(noise: float, start: Any) -> SafetyProblem:
    """The vehicle up to the longest horizon."""
    options = {"noise": noise, "start": start, "box": BOX, "dt": STEP, "horizon": max(HORIZONS)}
    return load_problem(DUBINS, {**options, "barrier": {"radius": RADIUS}})


def _run(noise: float, start: Any, episodes: int, seed: int) -> Evaluation:
    return evaluate(dubins_problem(noise, start), "zero", list(FILTERS.values()), episodes=episodes, seed=seed, bounds=False)


def _safe(row: Row, horizon: float) -> int:
    """How many episodes are safe up to a horizon."""
    curve = row["curve"]
    return curve["safe"][int(np.argmin(np.abs(np.array(curve["time"]) - horizon)))]


def _rows(evaluation: Evaluation) -> dict[str, Row]:
    return dict(zip(FILTERS, evaluation.rows, strict=True))


def _numbers(runs: Mapping[str, Mapping[str, Row]], horizon: float) -> list[Number]:
    """The rate of each filter in each run."""
    return [
        Number.rate(f"{name}, {where}", _safe(row, horizon), row["episodes"]) for where, rows in runs.items() for name, row in rows.items()
    ]


def turning_time(better: Row, other: Row) -> float | None:
    """From when on more episodes are safe with the first row than with the other, in s; None if not at the end."""
    ahead = np.array(better["curve"]["safe"]) > np.array(other["curve"]["safe"])
    if not ahead[-1]:
        return None
    behind = np.flatnonzero(~ahead)
    return float(better["curve"]["time"][behind[-1] + 1 if behind.size else 0])


def _as_text(time: float | None) -> str:
    return f"not up to {max(HORIZONS):g} s" if time is None else f"from {time:.2f} s on"


def compute_noises(sample: Sample) -> Outcome:
    """Figure 4.2: safety against noise, from random starts."""
    episodes = sample.size(EPISODES)
    levels = sorted((*NOISES, *(() if sample.quick else BETWEEN)))
    runs = {start: {level: _rows(_run(level, start, episodes, sample.seed)) for level in levels} for start in STARTS}
    named = {start: {f"sigma = {level:g}": runs[start][level] for level in NOISES} for start in STARTS}
    elsewhere = {f"{STARTS[s]}, T = {t:g} s": Outcome(_numbers(named[s], t), [_better_claim(runs[s], t)]) for s in STARTS for t in HORIZONS}
    main = f"{STARTS['inward']}, T = {HORIZON:g} s"
    return Outcome(
        numbers=elsewhere.pop(main).numbers,
        claims=[_better_claim(runs["inward"], HORIZON), _better_claim(runs["inward"], max(HORIZONS))],
        elsewhere=elsewhere,
        as_printed=[
            Number.rate(f"SZCBF, sigma = {level:g}", _printed_safe(level, "inward", episodes, sample.seed), episodes) for level in NOISES
        ],
        data={
            "noises": levels,
            "rates": {s: {n: [_band(runs[s][level][n], HORIZON) for level in levels] for n in FILTERS} for s in STARTS},
            "curves": {s: {n: _curve(runs[s][max(NOISES)][n]) for n in FILTERS} for s in STARTS},
        },
        notes=[*_turns(runs), *_infeasible(runs)],
    )


def _better_claim(by_noise: Mapping[float, Mapping[str, Row]], horizon: float) -> Claim:
    noisy = {level: rows for level, rows in by_noise.items() if level > 0}
    gaps = {level: (_safe(r["SCBF"], horizon) - _safe(r["SZCBF"], horizon)) / r["SCBF"]["episodes"] for level, r in noisy.items()}
    least = min(gaps, key=lambda level: gaps[level])
    return Claim(
        f"SCBF has the better safety probability at every noise level up to T = {horizon:g} s",
        min(gaps.values()) > 0,
        f"ahead of SZCBF by at least {100 * gaps[least]:.1f} points (sigma = {least:g}), at most {100 * max(gaps.values()):.1f}",
    )


def _printed_safe(noise: float, start: Any, episodes: int, seed: int) -> int:
    """How many episodes are safe under SZCBF by the printed h_2, with the same starts and noise as for the others."""
    problem = dubins_problem(noise, start)
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, min(episodes, 1024)), PrintedSZCBF(ALPHAS["SZCBF"]))
    return _safe(run_episodes(env, ZeroController(problem), episodes, seed).row(0.95), HORIZON)


def _turns(runs: Mapping[str, Mapping[float, Mapping[str, Row]]]) -> list[str]:
    """From when on SCBF is the safer one."""
    rows = {start: by_noise[max(NOISES)] for start, by_noise in runs.items()}
    return [
        f"sigma = {max(NOISES):g}, {STARTS[s]}: SCBF is the safer one than {n} {_as_text(turning_time(rows[s]['SCBF'], rows[s][n]))}"
        for s in STARTS
        for n in ALPHAS
    ]


def _infeasible(runs: Mapping[str, Mapping[float, Mapping[str, Row]]]) -> list[str]:
    rows = runs["inward"][max(NOISES)]
    shares = ", ".join(f"{name} {100 * (row['infeasible_rate'] or 0.0):.2g} %" for name, row in rows.items())
    return [f"steps in which no turn rate in the box meets the condition, sigma = {max(NOISES):g}: {shares}"]


def _band(row: Row, horizon: float) -> list[float]:
    number = Number.rate("", _safe(row, horizon), row["episodes"])
    return [float(number.low or 0.0), number.ours, float(number.high or 0.0)]


def _curve(row: Row) -> dict[str, list[float]]:
    return {key: row["curve"][key] for key in ("time", "rate", "ci_low", "ci_high")}


def random_starts(start: str, seed: int) -> np.ndarray:
    """Ten states from a distribution of starts, shape (10, 3)."""
    world = SafeVectorEnv(dubins_problem(NOISE, start), POINTS)
    world.reset(seed=[episode_seed(seed, i) for i in range(POINTS)])
    return world.state


def compute_points(sample: Sample) -> Outcome:
    """Figure 4.3: safety from ten random starts, many episodes each."""
    episodes = sample.size(EPISODES_OF_POINT)
    seeds = [episode_seed(sample.seed, i) for i in range(POINTS)]
    starts = {kind: random_starts(kind, sample.seed).tolist() for kind in STARTS if kind == "inward" or not sample.quick}
    runs = {k: [_rows(_run(NOISE, x, episodes, seed)) for x, seed in zip(xs, seeds, strict=True)] for k, xs in starts.items()}
    elsewhere = {
        f"{STARTS[kind]}, T = {t:g} s": Outcome(_overall_numbers(of_kind, t), [_overall(of_kind, t)])
        for kind, of_kind in runs.items()
        for t in HORIZONS
    }
    rows = runs["inward"]
    printed = sum(_printed_safe(NOISE, x, episodes, seed) for x, seed in zip(starts["inward"], seeds, strict=True))
    bounds = _bounds(np.array(starts["inward"]))
    each = {f"start {i}": {name: row[name] for name in ("SCBF", "SZCBF")} for i, row in enumerate(rows, 1)}
    return Outcome(
        numbers=[*elsewhere.pop(f"{STARTS['inward']}, T = {HORIZON:g} s").numbers, *_numbers(each, HORIZON)],
        claims=[_overall(rows, HORIZON), _overall(rows, max(HORIZONS))],
        elsewhere=elsewhere,
        as_printed=[Number.rate("SZCBF, all ten starts", printed, episodes * POINTS)],
        data={
            "starts": starts["inward"],
            "rates": {n: {f"{t:g}": [_band(r[n], t) for r in rows] for t in HORIZONS} for n in FILTERS},
            "product": bounds[0].tolist(),
        },
        notes=[_bound_note(rows, *bounds)],
    )


def _overall_numbers(rows: Sequence[Mapping[str, Row]], horizon: float) -> list[Number]:
    trials = sum(r["SCBF"]["episodes"] for r in rows)
    return [Number.rate(f"{name}, all ten starts", sum(_safe(r[name], horizon) for r in rows), trials) for name in FILTERS]


def _overall(rows: Sequence[Mapping[str, Row]], horizon: float) -> Claim:
    gaps = [(_safe(r["SCBF"], horizon) - _safe(r["SZCBF"], horizon)) / r["SCBF"]["episodes"] for r in rows]
    return Claim(
        f"SCBF is safer than SZCBF over all starts together, up to T = {horizon:g} s",
        sum(gaps) > 0,
        f"by {100 * np.mean(gaps):.1f} points on average, from {sum(g > 0 for g in gaps)} of the {len(gaps)} starts, "
        f"between {100 * min(gaps):.1f} and {100 * max(gaps):.1f} points",
    )


def _bounds(starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thm. 4.2.10's product and the proved union bound for ever, at each start."""
    formulas = Formulas(dubins_problem(NOISE, "inward"), [SCBF()], "model")
    speed = next(value for symbol, value in formulas.system.parameters.items() if symbol.name == "v")
    # A h = -2 v (x cos + y sin) - 2 sigma^2 is largest at the edge, straight inwards.
    suprema = [RADIUS**2, 2 * speed * RADIUS - 2 * NOISE**2]
    b = formulas.chain(starts)
    return theorem_4_2_10_printed(b, suprema), union_bound(b, suprema)


def _bound_note(rows: Sequence[Mapping[str, Row]], product: np.ndarray, union: np.ndarray) -> str:
    last = [_band(r["SCBF"], max(HORIZONS)) for r in rows]
    below = sum(high < 100 * p for (_, _, high), p in zip(last, product, strict=True))
    share = np.mean([r["SCBF"]["infeasible_rate"] or 0.0 for r in rows])
    return (
        f"Thm. 4.2.10's product b_0 b_1/(c_0 c_1) is {100 * product.min():.1f} to {100 * product.max():.1f} % at these starts, "
        f"and contradicted at {below} of {len(rows)} by T = {max(HORIZONS):g} s; the union bound is at most {100 * union.max():.1f} %. "
        f"Both presume the condition, which no turn rate meets in {100 * share:.1f} % of the steps"
    )


def draw_noises(figure: Figure, outcome: Outcome) -> None:
    """Left: safety against noise. Right: over time at the largest noise. Full lines: starts with A h > 0; dashed: all."""
    left, right = figure.subplots(1, 2, sharey=True)
    data = outcome.data
    for kind, dashes in zip(STARTS, ("-", "--"), strict=True):
        for name in FILTERS:
            label = _LABEL[name] if dashes == "-" else None
            low, rate, high = np.array(data["rates"][kind][name]).T
            left.fill_between(data["noises"], low, high, color=_COLOR[name], alpha=0.15, linewidth=0)
            left.plot(data["noises"], rate, dashes, color=_COLOR[name], label=label, marker="o", markersize=3)
            curve = data["curves"][kind][name]
            low, rate, high = (100 * np.array(curve[key]) for key in ("ci_low", "rate", "ci_high"))
            right.fill_between(curve["time"], low, high, color=_COLOR[name], alpha=0.15, linewidth=0)
            right.plot(curve["time"], rate, dashes, color=_COLOR[name])
        left.plot([], [], dashes, color="black", label=STARTS[kind])
    for horizon in HORIZONS:
        right.axvline(horizon, color=UNSAFE, linewidth=0.8, zorder=0)
    left.set(
        xlabel=r"noise $\sigma_1 = \sigma_2$ (m/$\sqrt{\mathrm{s}}$)", ylabel="safe (%)", ylim=(-2, 102), title=f"(a) T = {HORIZON:g} s"
    )
    right.set(xlabel="horizon T (s)", xlim=(0, max(HORIZONS)), title=rf"(b) $\sigma$ = {max(NOISES):g} m/$\sqrt{{\mathrm{{s}}}}$")
    add_legend(figure, left.get_legend_handles_labels()[0])


def draw_points(figure: Figure, outcome: Outcome) -> None:
    """Left: safety from each start, filled at the short horizon, hollow at the long one. Right: the starts."""
    left, right = figure.subplots(1, 2, width_ratios=(1.7, 1))
    data = outcome.data
    index = np.arange(1, len(data["starts"]) + 1)
    for i, name in enumerate(FILTERS):
        style: Any = {"fmt": "os^"[i], "color": _COLOR[name], "markersize": 4.5, "linewidth": 1}
        for horizon, face, label in ((HORIZON, _COLOR[name], _LABEL[name]), (max(HORIZONS), "white", None)):
            low, rate, high = np.array(data["rates"][name][f"{horizon:g}"]).T
            left.errorbar(index + 0.22 * (i - 1), rate, (rate - low, high - rate), markerfacecolor=face, label=label, **style)
    left.plot(index, 100 * np.array(data["product"]), "_", color="black", markersize=14, label="product of Thm. 4.2.10")
    for horizon, face in ((HORIZON, "black"), (max(HORIZONS), "white")):
        left.plot([], [], "o", color="black", markerfacecolor=face, markersize=4.5, label=f"T = {horizon:g} s")
    left.set(xlabel="start", ylabel="safe (%)", xticks=index, ylim=(-3, 103), title="(a)")
    _draw_starts(right, np.array(data["starts"]))
    handles, labels = left.get_legend_handles_labels()
    add_legend(figure, [handles[labels.index(label)] for label in sorted(labels, key=lambda label: label not in _LABEL.values())])


def _draw_starts(axes: Axes, starts: np.ndarray) -> None:
    """The disk with the starts and their headings, each number behind its arrow."""
    axes.set_facecolor(to_rgba(UNSAFE, 0.35))
    axes.add_patch(Circle((0, 0), RADIUS, facecolor="white", edgecolor="black", linewidth=1.2))
    x, y = starts[:, :2].T
    along, up = np.cos(starts[:, 2]), np.sin(starts[:, 2])
    axes.quiver(x, y, along, up, color=QUIET, scale=9, width=0.009)
    for i, place in enumerate(zip(x - 0.28 * along, y - 0.28 * up, strict=True), 1):
        axes.text(*place, str(i), ha="center", va="center", fontsize=8)
    edge = 1.12 * RADIUS
    axes.set(xlabel="x (m)", ylabel="y (m)", xlim=(-edge, edge), ylim=(-edge, edge), aspect="equal", title="(b)")


_SETTING = (
    f"v = 2 m/s, disk of radius {RADIUS:g} m, control period {STEP} s, min omega^2 subject to the row and |omega| <= {BOX[1]:g} rad/s",
    "SZCBF with rates 1, 1 (and .5, .5), h_2 = A h_1 + alpha_2 h_1; safe: h > 0 at every control instant up to T",
)
_CHOSEN = (
    "T is not printed: 3, 5 and 10 s, the numbers for 5 s",
    "starts uniform in the disk and in heading, kept where A h > 0 as Thm. 4.2.10 presumes; all starts beside them",
    "nominal turn rate 0, the box of the turn rate and the rates of the SZCBF",
)
_CORRECTIONS = (
    "Sec. 4.3.2: h_2 = A h_1 + alpha_2 h_1, not alpha_2 h; by the print even paths without noise can leave the set",
    "Thm. 4.2.10: the product is no proved bound for degree 2, since Eq. (4.23) conditions on the future; the union bound is",
)

ARTEFACTS: tuple[Artefact, ...] = (
    Artefact(
        name="figure-4.2",
        title="Safety of SCBF and SZCBF against the noise",
        compute=compute_noises,
        setting=(*_SETTING, f"{EPISODES} random starts, the same ones and the same noise for all filters"),
        chosen=_CHOSEN,
        corrections=_CORRECTIONS,
        draw=draw_noises,
        size=(7.0, 4.0),
    ),
    Artefact(
        name="figure-4.3",
        title="Safety of SCBF and SZCBF from ten random starts",
        compute=compute_points,
        setting=(*_SETTING, f"sigma = {NOISE:g} m/sqrt(s), {POINTS} random starts, {EPISODES_OF_POINT} episodes from each"),
        chosen=_CHOSEN,
        corrections=_CORRECTIONS,
        draw=draw_points,
        size=(7.0, 4.0),
    ),
)
