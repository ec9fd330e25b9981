"""`safe-envs identify` as a person types it."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from safe_envs.agents.jobs.store import package_versions
from safe_envs.filters.learning import METHODS, learner_of, load_learned
from safe_envs.filters.learning.collection import collect
from safe_envs.filters.learning.data import Transitions
from safe_envs.registry import make_problem
from safe_envs.scripts.options.method_settings import SETTINGS, read_settings, settings_of
from safe_envs.scripts.reports.identify import DataFile, Function, unit_of
from safe_envs.scripts.reports.tables import relative_text
from tests.scripts.conftest import strictly
from tests.scripts.figures.svg_texts import svg_texts
from tests.scripts.own_system import SYSTEM

pytestmark = pytest.mark.slow

SMALL = ("--set", "starts=10", "--set", "steps=20", "--set", "repetitions=10")
BAYESIAN = ("CubicSDEDisk-v0", "--method", "bayesian", *SMALL, "--set", "degree=2")
NETWORK = ("Pendulum-v0", "--method", "ddscbf", "--set", "points=20", "--set", "repetitions=50")
DIRECT = (
    "StochasticDubins-v0",
    "--method",
    "ddscbf",
    "--set",
    "points=20",
    "--set",
    "repetitions=50",
)
RESIDUAL = (
    "DubinsDisk-v0",
    "--method",
    "learned-hocbf",
    "--set",
    "states=60",
    "--set",
    "epochs=3",
    "--set",
    "hidden=8,4",
)
PLAIN = BAYESIAN[:3]
QUICK = {"bayesian": BAYESIAN, "ddscbf": NETWORK, "learned-hocbf": RESIDUAL}


@pytest.fixture
def identify(safe_envs_command):
    """Runs `safe-envs identify`."""
    return lambda *arguments: safe_envs_command("identify", *arguments)


@pytest.fixture(scope="module")
def bad_files(tmp_path_factory):
    """A folder of files that cannot be learned from."""
    folder, pendulum = tmp_path_factory.mktemp("bad"), make_problem("Pendulum-v0")
    (folder / "damaged.npz").write_bytes(b"PK")
    collect(pendulum, 5, 2).save(folder / "other.npz")
    learner_of("ddscbf")(pendulum, points=5, repetitions=2, way="direct").save(folder / "model.npz")
    return folder


@pytest.mark.parametrize(
    ("arguments", "texts", "drawn"),
    [
        (
            BAYESIAN,
            (
                "safe_envs/CubicSDEDisk-v0 | method bayesian | seed 0",
                "noise sigma_1 = 0.2, sigma_2 = 0.2, model = plant",
                "from 4,000 transitions that last 40 s together",
                "starts = 10, steps = 20, repetitions = 10, degree = 2",
                "error  noise  standardised",
                "covariance[x_1, x_1]",
                "0 in truth and estimate: g[x_1, u], covariance[x_1, x_2]",
                "--filter bayesian-scbf --learned out.npz",
            ),
            (
                "f of x_{1}\nerror",
                r"truth [\mathrm{1}/\mathrm{s}]",
                r"\sigma of x_{2}",
                "samples of the posterior",
            ),
        ),
        (
            NETWORK,
            (
                "way = network",
                "against the labels, median; and",
                "M_1(h), standard error of labels",
                "--filter ddscbf --learned out.npz",
            ),
            ("M_{1}(h)\nerror", "estimate at a state"),
        ),
        (
            DIRECT,
            (
                "way = direct",
                "errors: of the covariances, root mean square\n",
                "C(x, x)",
                "m^2/s",
                "C(theta, theta)",
            ),
            ("C(y, y)\nerror", "truth 0.04\n", "estimate 0.0"),
        ),
        (
            RESIDUAL,
            (
                "hidden = 8,4",
                "rms",
                "q95",
                "h Delta_1",
                "h Sigma_omega",
                "--filter learned-hocbf --learned out.npz",
            ),
            (),
        ),
    ],
)
def test_the_report_names_what_was_learned_and_the_picture_shows_it(
    identify, arguments, texts, drawn, tmp_path
):
    status, out, err = identify(
        *arguments, "--out", "out.npz", *(("--plot", "out.svg") if drawn else ())
    )
    assert (status, err) == (0, "")
    for text in (
        *texts,
        "Learned in",
        "Held-out errors",
        "Truth against estimate",
        "1000 fresh states",
        "Written to out.npz",
    ):
        assert text in out
    assert all(text in svg_texts("out.svg") for text in drawn)


@pytest.mark.parametrize("method", METHODS)
def test_the_file_loads_again(identify, method, tmp_path):
    env_id, *rest = QUICK[method]
    assert identify(env_id, *rest, "--seed", 3, "--json", "out.json", "--out", "out.npz")[0] == 0
    model = load_learned(tmp_path / "out.npz", make_problem(env_id), method)
    document = strictly("out.json")
    assert document["sha256"] == model.sha256
    assert document["record"]["transitions"] == model.record.transitions
    assert model.record.seed == 3


def test_json_holds_all_of_it(identify):
    assert (
        identify(*BAYESIAN, "--noise", "0.1,0.3", "--json", "out.json", "--out", "out.npz")[0] == 0
    )
    document = strictly("out.json")
    assert document["config"] == {
        "env_id": "safe_envs/CubicSDEDisk-v0",
        "options": {"noise": [0.1, 0.3]},
        "method": "bayesian",
        "seed": 0,
        "data": None,
    }
    assert document["versions"] == package_versions()
    assert document["record"]["settings"]["repetitions"] == 10
    functions = {entry["name"]: entry for entry in document["functions"]}
    assert functions["covariance[x_2, x_2]"]["size"] == pytest.approx(0.09)
    assert functions["f[x_1]"]["relative"] == pytest.approx(
        functions["f[x_1]"]["error"] / functions["f[x_1]"]["size"]
    )
    assert functions["g[x_1, u]"]["relative"] is None


def test_the_same_seed_gives_the_same_file(identify, tmp_path):
    hashes = []
    for seed in (1, 1, 2):
        assert identify(*DIRECT, "--seed", seed, "--json", "out.json", "--out", "out.npz")[0] == 0
        hashes.append(
            [function["error"] for function in strictly(tmp_path / "out.json")["functions"]]
        )
    assert hashes[0] == hashes[1] != hashes[2]


@pytest.mark.slow
def test_learning_from_a_file_of_data(identify, tmp_path):
    path = "some data.npz"
    collect(make_problem("CubicSDEDisk-v0"), 40, 5, seed=7, dt=0.02).save(tmp_path / path)
    status, out, err = identify(
        *PLAIN,
        "--data",
        path,
        "--noise",
        "0.3",
        "--json",
        "out.json",
        "--plot",
        "out.svg",
        "--out",
        "out.npz",
    )
    assert (status, err) == (0, "")
    assert "| method bayesian | data some data.npz\n" in out
    assert (
        "transitions of some data.npz that last 8 s together, in steps of 0.02 s, of the seed 7\n"
        in out
    )
    compared = (
        "compared with noise sigma_1 = 0.3, sigma_2 = 0.3, model = plant, at states of the seed 0"
    )
    assert compared in out
    drawn = svg_texts("out.svg").replace("\n", " ")
    assert "compared with noise" in drawn
    assert "at states of the seed 0" in drawn
    assert "dt = 0.01" not in out
    assert strictly("out.json")["config"]["data"] == path
    assert load_learned("out.npz", make_problem("CubicSDEDisk-v0")).record.seed == 7


def test_what_is_said_of_data_from_elsewhere():
    data = collect(make_problem("CubicSDEDisk-v0"), 4)
    logged = Transitions.from_log(
        data.signature, data.x, data.u, data.successors[:, 0], 0.01 * np.arange(1, data.points + 1)
    )
    assert (
        str(DataFile(Path("log.npz"), logged))
        == f"in steps of 0.01 to {0.01 * data.points:g} s, from elsewhere"
    )


def test_what_is_proposed_keeps_the_options_of_the_env(identify):
    given = ["--noise=0.1", "--plant=sigma_1=0.3", "--dt=0.02"]
    status, out, _ = identify(*BAYESIAN, *given, "--out", "my file.npz")
    assert status == 0
    expected = [
        "safe-envs",
        "evaluate",
        "safe_envs/CubicSDEDisk-v0",
        "--filter",
        "bayesian-scbf",
        "--learned",
        "my file.npz",
        *given,
    ]
    assert shlex.split(out.splitlines()[-1]) == expected


def test_warnings_are_printed_as_notes(identify):
    status, out, err = identify(
        *BAYESIAN[:-2], "--noise", "0.01", "--set", "degree=1", "--out", "out.npz"
    )
    assert (status, err) == (0, "")
    assert "Note: x_2: features of degree 1 miss" in out


def test_what_cannot_be_compared_is_said(identify):
    """Of the second derivative's noise part there is no truth where f and g are not known."""
    learned = (
        "--set",
        "way=network",
        "--set",
        "points=20",
        "--set",
        "repetitions=20",
        "--model",
        "v=1.2",
    )
    status, out, _ = identify(
        "StochasticDubins-v0",
        "--method",
        "ddscbf",
        *learned,
        "--plot",
        "out.svg",
        "--out",
        "out.npz",
    )
    assert status == 0
    assert "Truth against estimate" not in out
    assert "differ in f or g" in out


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        ((*BAYESIAN, "--set", "diffusion_degree=1"), ("covariance of x_{2}, x_{2}\nerror",)),
        (
            ("QuadrotorAltitude-v0", *RESIDUAL[1:]),
            ("h \\Delta_{2}\ntruth 0\ntruth 0\n", "estimates at all states", " to "),
        ),
    ],
)
def test_the_picture_is_drawn(identify, arguments, texts, tmp_path):
    assert identify(*arguments, "--plot", "out.svg", "--out", "out.npz")[0] == 0
    picture = svg_texts("out.svg")
    for text in texts:
        assert text in picture


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("Nothing-v0", "--method", "bayesian"), "unknown env"),
        (("Pendulum-v0", "--method", "bayes"), "did you mean 'bayesian'?"),
        ((*BAYESIAN, "--set", "degre=2"), "did you mean 'degree'?"),
        ((*BAYESIAN, "--set", "seed=2"), "no setting 'seed'"),
        ((*BAYESIAN, "--set", "degree"), "give NAME=VALUE"),
        ((*BAYESIAN, "--set", "prior=wide"), "'wide' is not a number"),
        ((*BAYESIAN[:-2], "--set", "degree=1.5"), "give a whole number"),
        ((*BAYESIAN, "--set", "prior=-1"), "positive and finite"),
        ((*RESIDUAL[:-2], "--set", "hidden=8,wide"), "hidden=100,30"),
        ((*RESIDUAL[:-2], "--set", "hidden=8,1.5"), "hidden=100,30"),
        ((*RESIDUAL[:-2], "--noise", "0.1"), "noise"),
        ((*NETWORK, "--set", "estimator=guess"), "allowed: printed, centred, martingale"),
        ((*NETWORK, "--set", "way=3"), "way = '3'"),
        ((*NETWORK[:-4], "--set", "points=3"), "at least 10"),
        ((*BAYESIAN, "--seed", "-1"), "seed = -1"),
        ((*PLAIN, "--data", "missing.npz"), "does not exist"),
        ((*PLAIN, "--data", "damaged.npz"), "truncated"),
        ((*PLAIN, "--data", "other.npz"), "of another problem"),
        (
            (*BAYESIAN, "--data", "other.npz"),
            "--set starts, --set steps, --set repetitions: not allowed with --data",
        ),
        (
            (*PLAIN, "--data", "other.npz", "--dt", "0.1", "--substeps", "2", "--box", "0,1"),
            "--dt, --substeps, --box: not allowed",
        ),
        (
            (*PLAIN, "--data", "other.npz", "--out", "other.npz"),
            "--out other.npz would overwrite the file of --data other.npz",
        ),
        (
            (*BAYESIAN, "--json", "./out.npz"),
            "--json out.npz would overwrite the file of --out out.npz",
        ),
        (
            (*BAYESIAN, "--json", "found.svg", "--plot", "found.svg"),
            "--plot found.svg would overwrite the file of --json found.svg",
        ),
        (("Pendulum-v0", "--method", "ddscbf", "--data", "model.npz"), "holds"),
        ((*RESIDUAL, "--data", "other.npz"), "leave --data out"),
        ((*BAYESIAN, "--json", "missing/found.json"), "does not exist"),
        ((*BAYESIAN, "--plot", "found.xyz"), "unknown format"),
        ((*BAYESIAN, "--out", "missing/out.npz"), "the folder"),
        ((*BAYESIAN, "--out", "."), "it is a folder"),
    ],
)
def test_errors_of_the_user_end_with_status_2(identify, bad_files, arguments, message, tmp_path):
    shutil.copytree(bad_files, tmp_path, dirs_exist_ok=True)
    status, out, err = identify("--out", "out.npz", *arguments)
    assert status == 2
    assert message in " ".join(err.split())
    assert "Traceback" not in err
    assert not out
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize("left_out", ["--method", "--out"])
def test_what_is_required(identify, left_out):
    given = {"--method": "bayesian", "--out": "out.npz"}
    del given[left_out]
    status, _, err = identify("Pendulum-v0", *[word for pair in given.items() for word in pair])
    assert status == 2
    assert left_out in err


def test_settings_are_read_by_the_kind_of_the_argument():
    residual = read_settings(
        "learned-hocbf", learner_of("learned-hocbf"), ["hidden=7", "label_dt=1e-2", "states=50"]
    )
    assert residual == {"hidden": [7], "label_dt": 0.01, "states": 50}
    assert read_settings("ddscbf", learner_of("ddscbf"), ["way=direct", "points=20"]) == {
        "way": "direct",
        "points": 20,
    }
    assert read_settings("bayesian", learner_of("bayesian"), ["degree=2"]) == {"degree": 2}


def test_whole_numbers_may_be_written_as_floats():
    found = read_settings(
        "bayesian", learner_of("bayesian"), ["starts=1e3", "degree=2.0", "steps=1.5", "prior=2.0"]
    )
    assert found == {"starts": 1000, "degree": 2, "steps": 1.5, "prior": 2.0}
    assert [type(value) for value in found.values()] == [int, int, float, float]
    assert read_settings("learned-hocbf", learner_of("learned-hocbf"), ["hidden=1e2,30.0"]) == {
        "hidden": [100, 30]
    }
    assert read_settings("learned-hocbf", learner_of("learned-hocbf"), ["hidden=1e2"]) == {
        "hidden": [100]
    }


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


def test_the_help_shows_the_settings(identify):
    status, out, _ = identify("--help")
    assert status == 0
    for text in ("label_dt=0.001", "diffusion_degree=0", "estimator=martingale", ".webp"):
        assert text in out


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


def test_an_unbounded_state_asks_for_a_range_or_a_workspace(safe_envs_command):
    Path("own.py").write_text(SYSTEM)
    status, _, err = safe_envs_command(
        "identify", "--system", "own.py:problem", "--method", "bayesian", "--out", "learned.npz"
    )
    assert status == 2
    assert "finite ranges, or the problem a workspace" in err
