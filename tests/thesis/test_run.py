"""`python -m thesis`: what it prints, keeps and refuses; and every artefact at once."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from safe_envs.errors import ConfigurationError
from tests.scripts.conftest import strictly
from thesis import __main__ as command
from thesis import artefact, catalogue
from thesis.artefact import Claim, Number, Outcome, Sample, Texts, texts
from thesis.verdict import judge

ROOT = Path(__file__).parents[2]


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Runs the command in this process, in an empty folder; returns status and what it printed."""
    monkeypatch.chdir(tmp_path)

    def run_with(*words):
        monkeypatch.setattr("sys.argv", ["thesis", *map(str, words)])
        status = 0
        try:
            command.main()
        except SystemExit as ended:
            status = ended.code
        return status, *capsys.readouterr()

    return run_with


def throw(sample):
    """A fair coin, with a picture."""
    trials = sample.size(1000)
    outcome = Outcome(
        [Number.rate("heads", trials // 2, trials, 48.0, 50), Number("edge", 0.25, 0.2, 0.3)],
        [Claim("it lands", True, "1 of 1"), Claim("it rolls", False, "|v| = 0", printed=False)],
        notes=["a < b"],
    )
    return outcome, lambda figure: figure.subplots().plot([0.0, 1.0])


@pytest.fixture
def coin(monkeypatch):
    """Makes artefacts that cost nothing the only ones; returns the names that were computed."""
    computed = []

    def compute_of(name):
        computed.append(name)
        if name == "table-6.9":
            raise ValueError("no luck")
        return throw

    coin_texts = Texts("A coin", "coin", ("car",), ("by hand",), errata=("a sign", ("b", "c")))
    both = dict.fromkeys(("table-6.8", "table-6.9"), coin_texts)
    for module in (artefact, command, catalogue, "thesis.report"):
        module = module if isinstance(module, str) else module.__name__
        monkeypatch.setattr(f"{module}.texts", lambda: both)
    monkeypatch.setattr(catalogue, "compute_of", compute_of)
    monkeypatch.setattr(catalogue, "_SUFFIXES", (".svg",))  # which is enough to save here
    return computed


ONE = ("table-6.8", "--episodes", 100, "--jobs", 1, "--out", "report")


def test_without_an_argument_it_lists_the_artefacts(run):
    status, out, err = run()
    assert (status, err) == (0, "")
    assert [line.split()[0] for line in out.splitlines()] == list(texts())


def test_numbers_and_verdict_are_printed_and_kept_and_shown_on_a_page(run, coin):
    status, out, err = run(*ONE, "--json", "out.json")
    assert (status, err) == (0, "")
    for text in ("A coin", "reproduced", "heads", "48 % (of 50)", "50.0 %", "[40.4, 59.6]"):
        assert text in out
    assert re.search(r"it lands +yes", out)
    assert re.search(r"it rolls +no", out)
    (entry,) = strictly("out.json")["artefacts"]
    assert (entry["name"], entry["verdict"]) == ("table-6.8", "reproduced")
    assert entry["outcome"] == strictly("report/table-6.8.json")["outcome"]
    markdown, page = (Path(f"report/index.{kind}").read_text() for kind in ("md", "html"))
    assert "| heads | 48 % (of 50) | 50.0 % | [40.4, 59.6] |" in markdown
    assert "| it rolls | check of ours | no | \\|v\\| = 0 |" in markdown
    for text in ("by hand", "a sign", "table-6.8.svg", "every printed number", "# N of DDSCBF"):
        assert text in markdown
        assert text in page
    assert "a &lt; b" in page
    assert "http" not in page
    assert Path("report/table-6.8.svg").stat().st_size > 1000


def test_what_is_kept_is_not_computed_again(run, coin, monkeypatch):
    assert run(*ONE)[0] == 0
    assert run(*ONE)[0] == 0
    assert coin == ["table-6.8"]
    Path("report/table-6.8.svg").unlink()  # a picture that is missing is drawn again
    assert run(*ONE)[0] == 0
    monkeypatch.setattr(catalogue, "code_checksum", lambda: "another")
    assert catalogue.read(Path("report"), "table-6.8", Sample(100)) is None
    assert coin == ["table-6.8"] * 2


@pytest.mark.parametrize("more", [("--episodes", 101), ("--quick",), ("--seed", 1)])
def test_results_of_other_options_are_not_written_over(run, coin, more):
    assert run(*ONE)[0] == 0
    before = {path: path.read_bytes() for path in Path("report").iterdir()}
    status, _, err = run(*ONE, *more)
    assert status == 2
    assert 'report holds table-6.8 by other options: {"episodes": 100' in err
    assert {path: path.read_bytes() for path in Path("report").iterdir()} == before


def test_an_artefact_that_fails_leaves_the_others(run, coin):
    status, out, err = run("all", *ONE[1:])
    assert status == 2
    assert "table-6.9 failed: ValueError: no luck" in err
    assert "A coin" in out
    assert not Path("report/table-6.9.json").exists()


def test_a_quick_run_has_no_verdict(run, coin):
    status, out, _ = run("table-6.8", "--quick", "--jobs", 1)
    assert status == 0
    assert "no verdict, for a quick run" in out
    assert not re.search(r"^reproduced", out, re.MULTILINE)


@pytest.mark.parametrize("text", ["{", "[1]", '{"configuration": {}, "x": NaN}', ""])
def test_a_damaged_result_is_told_before_the_work(run, coin, text):
    Path("report").mkdir()
    Path("report/table-6.8.json").write_text(text)
    status, _, err = run(*ONE)
    assert status == 2
    assert "report/table-6.8.json cannot be read" in err
    assert not coin


def test_code_that_changed_during_a_run_is_not_kept(tmp_path, coin):
    job = catalogue.ArtefactJob("table-6.8", Sample(), tmp_path, "another checksum")
    with pytest.raises(ConfigurationError, match="the code changed during the run"):
        job.compute()
    assert not coin


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("table-9.9",), "table-9.9"),
        (("--out", "file"), "file"),
        (("--seed", -1), "seed"),
        (("--epsodes", 3), "--epsodes"),
        (("--json", "nowhere/out.json"), "nowhere"),
    ],
)
def test_what_it_cannot_take_ends_with_status_2_and_one_line(run, coin, words, name):
    Path("file").write_text("")
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert name in err
    assert err.count("\n") == 1
    assert not coin


def test_commands_of_the_pages_can_be_run():
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    pattern = r"(?:python -m thesis|make thesis ARGS=\")([^\n`\"]*)"
    found = [words for page in pages for words in re.findall(pattern, page.read_text())]
    assert len(found) > 3
    for word in " ".join(found).split():
        known = ("all", "--out", "report", "--quick", "--jobs", "4", "1", "trial", *texts())
        assert word in known, word


def checked(name, sample, folder):
    """Compute an artefact in a folder, and check what holds of every outcome; return it."""
    catalogue.ArtefactJob(name, sample, folder, catalogue.code_checksum()).compute()
    outcome, _ = catalogue.read(folder, name, sample) or pytest.fail("nothing is kept")
    assert outcome.document() == json.loads(json.dumps(outcome.document(), allow_nan=False))
    for suffix in (".png", ".pdf", ".svg"):
        assert (folder / f"{name}{suffix}").exists() == (not name.startswith("table"))
    assert all((outcome.numbers, outcome.claims))
    names = [number.name for number in outcome.numbers]
    assert len(set(names)) == len(names)
    assert {number.name for number in outcome.printed_formula} <= set(names)
    for number in [*outcome.numbers, *outcome.printed_formula]:
        assert number.ends[0] <= number.ours <= number.ends[1], number
    said = {claim.sentence for claim in outcome.claims if claim.printed}
    printed = {number.name for number in outcome.numbers if number.printed is not None}
    for other in outcome.alternative_settings.values():
        assert {claim.sentence for claim in other.claims if claim.printed} == said
        if other.numbers:
            assert {n.name for n in other.numbers if n.printed is not None} == printed
    assert judge(outcome, Sample()).reasons is not None
    return outcome


def test_an_artefact_from_end_to_end(tmp_path):
    sample = Sample(quick=True)
    outcome = checked("figure-6.2", sample, tmp_path)
    assert catalogue.compute_of("figure-6.2")(sample)[0].document() == outcome.document()
    pinned = {"sigma_1": 0.20041326102773238, "sigma_2": 0.19789432606563964}
    assert ours(outcome) == pytest.approx(pinned, rel=1e-6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Of the results of all artefacts, which share identifications."""
    return tmp_path_factory.mktemp("report")


def ours(outcome, part="numbers"):
    return {number.name: number.ours for number in getattr(outcome, part)}


FACTS = {
    "figure-3.1": lambda n, p: p["smallest h, p = 0.5"] > n["smallest h, p = 0.5"],
    "figure-3.2a": lambda n, _: n["path, true"] > n["path, none"],
    "figure-3.2b": lambda n, p: n["smallest h, true"] > 0 > p["smallest h, true"],
    "figure-3.3": lambda n, p: n["smallest h, true"] > -10 > p["smallest h, true"],
    "figure-4.2": lambda n, p: n["SZCBF(1, 1), sigma = 0"] > 50 > p["SZCBF(1, 1), sigma = 0"],
    "table-4.1": lambda n, _: n["SCBF, unbounded"] == 100.0,
    "figure-5.1": lambda n, p: p["rms error of the network"] > 50 * n["rms of the analytic term"],
    # It is the class-K term: without it there is next to no gap.
    "table-5.1": lambda n, _: n["CBF"] + 50 < n["CBF with alpha = 0"] > n["SCBF"] - 10,
    "table-5.2": lambda n, _: n["SCBF, k = 0.15"] > n["CBF, k = 0.15"] > n["no filter, k = 0.15"],
    "figure-6.2": lambda n, p: abs(n["sigma_1"] - 0.2) < 0.02 > abs(p["sigma_1"] - 0.02),
    "figure-6.4": lambda n, p: abs(n["sigma_1"] - 0.5) < 0.05 > abs(p["sigma_1"] - 0.05),
    "table-6.1": lambda n, _: n["MSE of f_1, K = 10"] > n["MSE of f_1, K = 100"],
    "table-6.2": lambda n, p: (
        abs(p["Analytical (-.1, .7)"] - 50) < 1e-6 > abs(n["Analytical (-.1, .7)"] - 42) - 0.1
    ),
    "figure-6.3": lambda n, _: n["relative rms error of f_2"] < 10,
    "table-6.4": lambda n, _: n["DDSCBF (thesis: more than)"] > n["Bayesian SCBF"],
}
"""What the quick numbers, and those by the printed formula, have to be like."""


@pytest.mark.oracle
@pytest.mark.parametrize("name", texts())
def test_every_artefact_at_a_twentieth_of_the_work(name, folder):
    outcome = checked(name, Sample(quick=True), folder)
    if name in FACTS:
        assert FACTS[name](ours(outcome), ours(outcome, "printed_formula"))


@pytest.mark.oracle
def test_processes_compute_what_a_single_one_does(run, tmp_path):
    names = ("figure-6.2", "figure-6.4")
    assert run(*names, "--quick", "--jobs", 2, "--out", "by-2")[0] == 0
    for name in names:
        alone = catalogue.compute_of(name)(Sample(quick=True))[0]
        assert strictly(tmp_path / "by-2" / f"{name}.json")["outcome"] == alone.document()
