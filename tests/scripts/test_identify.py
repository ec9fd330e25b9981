"""`safe-envs identify` as a person types it."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from safe_envs.filters.learning import METHODS, learner_of, load_learned
from safe_envs.filters.learning.collection import collect
from safe_envs.registry import make_problem
from safe_envs.scripts.options.settings import SETTINGS, read_settings, settings_of
from safe_envs.scripts.reports.identify import Function, unit_of
from safe_envs.scripts.reports.tables import relative_text
from tests.scripts.conftest import strictly
from tests.scripts.figures.svg_texts import svg_texts

pytestmark = pytest.mark.slow

PLAIN = "CubicSDEDisk-v0 --method bayesian"
SMALL = f"{PLAIN} --set starts=10 --set steps=20 --set repetitions=10"
BAYESIAN = f"{SMALL} --set degree=2"
NETWORK = "Pendulum-v0 --method ddscbf --set points=20 --set repetitions=50"
DIRECT = "StochasticDubins-v0 --method ddscbf --set points=20 --set repetitions=50"
RESIDUAL = "DubinsDisk-v0 --method learned-hocbf --set states=60 --set epochs=3 --set hidden=8,4"
QUICK = {"bayesian": BAYESIAN, "ddscbf": NETWORK, "learned-hocbf": RESIDUAL}


@pytest.fixture
def identify(safe_envs_command):
    """Runs `safe-envs identify`."""
    return lambda *arguments: safe_envs_command("identify", *arguments, "--out out.npz")


@pytest.mark.parametrize(
    ("line", "texts", "drawn"),
    [
        (
            BAYESIAN,
            "noise sigma_1 = 0.2, sigma_2 = 0.2|4,000 transitions that last 40 s|degree = 2"
            "|covariance[x_1, x_1]|0 in truth and estimate: g[x_1, u], covariance[x_1, x_2]",
            ("f of x_{1}\nerror", r"\sigma of x_{2}", "samples of the posterior"),
        ),
        (NETWORK, "way = network|M_1(h), standard error of labels", ("M_{1}(h)\nerror",)),
        (DIRECT, "way = direct|C(x, x)|m^2/s|C(theta, theta)", ("C(y, y)\nerror", "truth 0.04\n")),
        (RESIDUAL, "hidden = 8,4|rms|q95|h Delta_1|h Sigma_omega", ()),
    ],
)
def test_the_report_names_what_was_learned_and_the_picture_shows_it(identify, line, texts, drawn):
    status, out, err = identify(line, *(("--plot out.svg",) if drawn else ()))
    assert (status, err) == (0, "")
    more = ("Held-out errors", "Truth against estimate", "1000 fresh states", "Written to out.npz")
    for text in (*texts.split("|"), *more):
        assert text in out
    assert all(text in svg_texts("out.svg") for text in drawn)


@pytest.mark.parametrize(
    ("method", "seeds"), [("bayesian", (3, 3, 2)), ("ddscbf", (3,)), ("learned-hocbf", (3,))]
)
def test_the_file_loads_again_and_depends_on_the_seed_alone(identify, method, seeds):
    errors = []
    for seed in seeds:
        assert identify(QUICK[method], "--json out.json --seed", seed)[0] == 0
        document = strictly("out.json")
        errors.append([function["error"] for function in document["functions"]])
        model = load_learned("out.npz", make_problem(QUICK[method].split()[0]), method)
        assert document["sha256"] == model.sha256
        assert document["record"]["transitions"] == model.record.transitions
        assert model.record.seed == seed
    assert errors[:1] == errors[1:2] != errors[2:] or len(seeds) == 1


def test_learning_from_a_file_of_data(identify):
    collect(make_problem("CubicSDEDisk-v0"), 40, 5, seed=7, dt=0.02).save(Path("some data.npz"))
    status, out, err = identify(PLAIN, "--data 'some data.npz' --noise 0.3 --json out.json")
    assert (status, err) == (0, "")
    assert "some data.npz that last 8 s together, in steps of 0.02 s, of the seed 7\n" in out
    assert "compared with noise sigma_1 = 0.3, sigma_2 = 0.3, model = plant" in out
    assert "dt = 0.01" not in out
    assert strictly("out.json")["config"]["data"] == "some data.npz"
    assert load_learned("out.npz", make_problem("CubicSDEDisk-v0")).record.seed == 7


def test_what_is_proposed_keeps_the_options_of_the_env_and_warnings_are_notes(identify):
    given = ["--noise=0.01", "--plant=sigma_1=0.3", "--dt=0.02"]
    status, out, err = identify(SMALL, "--set degree=1", *given)
    assert (status, err) == (0, "")
    assert "Note: x_2: features of degree 1 miss" in out
    start = "safe-envs evaluate safe_envs/CubicSDEDisk-v0 --filter bayesian-scbf --learned out.npz"
    assert shlex.split(out.splitlines()[-1]) == [*start.split(), *given]


def test_what_cannot_be_compared_is_said(identify):
    """Of the second derivative's noise part there is no truth where f and g are not known."""
    line = "StochasticDubins-v0 --method ddscbf --set way=network --set points=20 --model v=1.2"
    status, out, _ = identify(line, "--set repetitions=20")
    assert status == 0
    assert "Truth against estimate" not in out
    assert "differ in f or g" in out


@pytest.mark.parametrize(
    ("method", "texts", "read"),
    [
        ("learned-hocbf", "hidden=7 label_dt=1e-2", {"hidden": [7], "label_dt": 0.01}),
        ("learned-hocbf", "hidden=1e2,30.0", {"hidden": [100, 30]}),
        ("ddscbf", "way=direct points=20", {"way": "direct", "points": 20}),
        (
            "bayesian",
            "starts=1e3 degree=2.0 prior=2.0",
            {"starts": 1000, "degree": 2, "prior": 2.0},
        ),
    ],
)
def test_settings_are_read_by_the_kind_of_the_argument(method, texts, read):
    found = read_settings(method, learner_of(method), texts.split())
    assert found == read
    assert [type(value) for value in found.values()] == [type(value) for value in read.values()]


@pytest.mark.parametrize("method", METHODS)
def test_the_help_names_every_setting_and_its_default(method):
    parameters = settings_of(learner_of(method))
    text = SETTINGS[method]
    assert [entry.split("=")[0] for entry in re.findall(r"(?:^|, )(\w+=)", text)] == list(
        parameters
    )
    for name, parameter in parameters.items():
        default = parameter.default
        shown = ",".join(map(str, default)) if isinstance(default, tuple) else default
        assert default is None or f"{name}={shown}" in text


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("f[v]", "m/s^2"),
        ("f[p]", "1/s"),
        ("g[v, u]", "m/s^2/N"),
        ("g[p, w]", ""),
        ("g[v, r]", "m/rad^2"),
        ("covariance[v, z]", "m^2/s^2"),
        ("C(v, v)", "m^2/s^3"),
        ("h Delta_1", ""),
        ("M_1(h)", ""),
    ],
)
def test_units(name, unit):
    assert (
        unit_of(name, {"v": "m/s", "z": "m", "p": "", "u": "N", "w": "1/s", "r": "rad^2/s^2"})
        == unit
    )


def test_errors_of_a_function():
    found = Function("f", "", np.array([3.0, -4.0]), np.array([3.0, -3.0]))
    assert found.size == pytest.approx(12.5**0.5)
    assert found.error == pytest.approx(0.5**0.5)
    assert found.relative == pytest.approx(0.2)
    assert found.largest == 1.0
    zero = np.zeros(2)
    assert Function("f", "", zero, zero).vanishes
    assert Function("f", "", zero, np.ones(2)).relative is None
    assert Function("f", "", 1e-17 * np.ones(2), np.ones(2)).relative is None
    assert [relative_text(share) for share in (0.0, 1e-3, 0.2, 12.0)] == [
        "< 1e-06 %",
        "0.1 %",
        "20 %",
        "1200 %",
    ]
