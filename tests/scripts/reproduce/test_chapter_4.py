"""The artefacts of chapter 4: that they run, and that they say what closed forms say."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

from safe_envs.barrier import Barrier
from safe_envs.calculus import generator
from scripts.reproduce import cruise, dubins_noise, martingale, store
from scripts.reproduce.artefact import Artefact, Outcome, Sample
from scripts.reproduce.verdict import Verdict, judge
from wrappers import SZCBF

ARTEFACTS = {a.name: a for module in (martingale, cruise, dubins_noise) for a in module.ARTEFACTS}
QUICK = Sample(quick=True)
_found: dict[str, Outcome] = {}


def outcome_of(name: str) -> Outcome:
    """The quick outcome, computed once."""
    if name not in _found:
        _found[name] = ARTEFACTS[name].compute(QUICK)
    return _found[name]


def ours(name: str) -> dict[str, Any]:
    """Numbers of an outcome by name."""
    return {number.name: number for number in outcome_of(name).numbers}


@pytest.fixture(params=list(ARTEFACTS))
def artefact(request: pytest.FixtureRequest) -> Artefact:
    """Each one."""
    return ARTEFACTS[request.param]


def test_goes_through_json_and_is_judged(artefact: Artefact) -> None:
    """An outcome is the same after it was written and read."""
    outcome = outcome_of(artefact.name)
    document = json.loads(json.dumps(outcome.document(), allow_nan=False))
    again = Outcome.from_document(document)
    assert again.document() == document
    assert judge(artefact, again) == judge(artefact, outcome)
    names = [number.name for number in outcome.numbers]
    assert len(set(names)) == len(names)
    assert {number.name for number in outcome.as_printed} <= set(names)


def test_is_drawn(artefact: Artefact, tmp_path: Path) -> None:
    """A figure becomes a picture, without warnings."""
    store.keep(tmp_path, artefact, QUICK, outcome_of(artefact.name), 0.0)
    assert (tmp_path / f"{artefact.name}.png").exists() == (artefact.draw is not None)


def test_same_seed_same_outcome(artefact: Artefact, monkeypatch: pytest.MonkeyPatch) -> None:
    """The seed is all that is random; shown on short episodes."""
    monkeypatch.setattr(martingale, "HORIZON", 0.2)
    monkeypatch.setattr(cruise, "HORIZON", 3.0)
    monkeypatch.setattr(dubins_noise, "HORIZONS", (0.2, 0.3, 0.4))
    monkeypatch.setattr(dubins_noise, "HORIZON", 0.3)
    monkeypatch.setattr(dubins_noise, "NOISES", (0.0, 0.2))
    monkeypatch.setattr(dubins_noise, "POINTS", 2)
    first, second = (artefact.compute(Sample(episodes=4, quick=True)) for _ in range(2))
    assert first.document() == second.document()


def test_no_pairs_of_orderings_are_misspelt(artefact: Artefact) -> None:
    """Orderings are of numbers that there are, as they are printed."""
    printed = {number.name: number.printed for number in outcome_of(artefact.name).numbers}
    assert all((printed[high] or 0.0) > (printed[low] or 0.0) for high, low in artefact.orderings)


def test_claims_hold_that_are_no_matter_of_chance() -> None:
    """What hangs on the conditions themselves holds for any sample."""
    held = {claim.sentence: claim.holds for name in ("example-4.2.2", "figure-4.1") for claim in outcome_of(name).claims}
    assert all(held[sentence] for sentence in held if "unbounded" in sentence or "bounded control at" in sentence or "no bound" in sentence)


def test_printed_inequalities() -> None:
    """u <= h^3 - x and u <= h^3 - x - sigma^2/h."""
    h = martingale.DISTANCES
    assert np.allclose(martingale.largest_inputs("rcbf", 0.0), h**3 - (1 - h), rtol=1e-6)
    assert np.allclose(martingale.largest_inputs("srcbf", 0.3), h**3 - (1 - h) - 0.09 / h, rtol=1e-6)


def test_bound_is_attained() -> None:
    """P(safe for ever) = 1 - x_0^2, and what is simulated is near the form for its horizon and step."""
    for start in martingale.STARTS:
        assert martingale.safe_up_to(start, math.inf) == pytest.approx(1 - start**2)
        assert martingale.safe_up_to(start, 60.0) == pytest.approx(1 - start**2, abs=1e-6)
        assert martingale.safe_up_to(start, 1.0) > martingale.safe_up_to(start, 2.0) > 1 - start**2
        number = ours("example-4.2.2")[f"SCBF where h/c is attained, x_0 = {start:g}"]
        expected = martingale.safe_up_to(start, martingale.HORIZON, martingale.STEP)
        assert abs(number.ours / 100 - expected) < 4 * math.sqrt(expected * (1 - expected) / 100)


def test_scalar_system_under_scbf_is_brownian() -> None:
    """With A h = 0, h = 1 - sigma W_t."""
    reach = 1 + martingale.SHIFT * martingale.NOISE * math.sqrt(martingale.STEP)
    expected = 1 - 2 * float(ndtr(-reach / (martingale.NOISE * math.sqrt(martingale.HORIZON))))
    rate = ours("example-4.2.2")["SCBF, unbounded"].ours / 100
    assert abs(rate - expected) < 4 * math.sqrt(expected * (1 - expected) / 100)


def test_force_near_the_edge() -> None:
    """At equal speeds SCBF balances the drag, and SRCBF brakes by M tau sigma^2/h more."""
    h, setting = cruise.DISTANCES, cruise.TAKEN
    drag = 0.1 + 5 * cruise.NEAR + 0.25 * cruise.NEAR**2
    asked = drag - cruise.WEIGHT / 9.81 / setting.tau * ((setting.tau * cruise.NOISE) ** 2 / h - setting.gamma * h**3)
    acting = h < 1.0
    assert np.allclose(cruise.needed("scbf"), drag)
    assert np.allclose(cruise.needed("srcbf")[acting], asked[acting], rtol=1e-6)


def test_printed_table_is_out_of_reach_of_the_default() -> None:
    """The Gaussian law, its inverse, and the simulation agree."""
    assert cruise.TAKEN.most_unsafe() == pytest.approx(2 * ndtr(-(150 - 15 * 1.8) / 18.0))
    assert cruise.TAKEN.most_unsafe() < 1e-11
    assert cruise.headway_for(cruise.MATCHING.most_unsafe()) == pytest.approx(cruise.MATCHING.tau)
    assert ours("table-4.1")["SCBF, unbounded"].ours == 100.0
    judgement = judge(ARTEFACTS["table-4.1"], outcome_of("table-4.1"))
    assert judgement.verdict in (Verdict.ELSEWHERE, Verdict.NOT)


def test_saturation_hurts_srcbf() -> None:
    """With the settings that match the table, far more than SCBF."""
    (matching,) = outcome_of("table-4.1").elsewhere.values()
    rate = {number.name: number.ours for number in matching.numbers}
    assert rate["SRCBF, unbounded"] - rate["SRCBF, bounded"] > rate["SCBF, unbounded"] - rate["SCBF, bounded"] + 10


def test_peak_effort() -> None:
    """SRCBF acts with the larger force."""
    numbers = ours("figure-4.1")
    assert numbers["peak force of SRCBF where it acts, median"].ours > numbers["peak force of SCBF where it acts, median"].ours


def test_printed_zeroing_form() -> None:
    """The printed row is the corrected one less alpha_2 (h_1 - h), and lets paths without noise out."""
    model = dubins_noise.dubins_problem(0.1, "inward").model
    barrier: Barrier = dubins_noise.dubins_problem(0.1, "inward").barriers[0]
    printed, corrected = (kind((2.0, 3.0)).constraint(model, barrier) for kind in (dubins_noise.PrintedSZCBF, SZCBF))
    h = barrier.expression
    missing = 3 * (generator(model, h) + 2 * h - h)
    assert (corrected.offset - printed.offset - missing).expand().simplify() == 0
    assert printed.coefficient[0].equals(corrected.coefficient[0])
    as_printed = {number.name: number for number in outcome_of("figure-4.2").as_printed}
    assert as_printed["SZCBF, sigma = 0"].ours < 50.0 < ours("figure-4.2")["SZCBF, sigma = 0"].ours == 100.0


def test_scbf_is_safer_only_in_the_long_run() -> None:
    """From starts with A h > 0 at 5 s; from all starts it is not yet at 3 s without noise."""
    numbers = ours("figure-4.2")
    assert numbers["SCBF, sigma = 0.2"].low > numbers["SZCBF, sigma = 0.2"].high
    early = {number.name: number.ours for number in outcome_of("figure-4.2").elsewhere["all starts, T = 3 s"].numbers}
    assert early["SCBF, sigma = 0"] < early["SZCBF, sigma = 0"]


def test_turning_time() -> None:
    """The first instant from which on the first row stays ahead."""
    time = [0.0, 1.0, 2.0, 3.0]
    row, other = ({"curve": {"time": time, "safe": safe}} for safe in ([9, 8, 7, 7], [9, 7, 7, 3]))
    assert dubins_noise.turning_time(row, other) == 3.0
    assert dubins_noise.turning_time(other, row) is None


def test_starts_are_inward() -> None:
    """Ten different starts in the disk, with A h > 0."""
    starts = dubins_noise.random_starts("inward", 0)
    x, y, heading = starts.T
    assert starts.shape == (10, 3)
    assert (np.hypot(x, y) < dubins_noise.RADIUS).all()
    assert (-4 * (x * np.cos(heading) + y * np.sin(heading)) - 2 * dubins_noise.NOISE**2 > 0).all()
    assert not np.array_equal(starts, dubins_noise.random_starts("inward", 1))
