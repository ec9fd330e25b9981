"""`safe-envs reproduce` as a person types it, with an artefact that costs nothing."""

from __future__ import annotations

import json
import time
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

import pytest

from safe_envs.errors import ConfigurationError, WorkersLostError
from scripts.reproduce.artefact import Outcome, Sample
from scripts.reproduce.catalogue import ARTEFACTS
from scripts.reproduce.command import compute_one
from scripts.reproduce.store import keep, read, source_checksum
from tests.scripts.conftest import strictly

ALL = [f"figure-{n}" for n in ("3.1", "3.2a", "3.2b", "3.3", "4.1", "4.2", "4.3", "5.1", "5.2", "5.3a", "5.3b", "5.3c", "5.3d")]
ALL += (
    [f"figure-6.{n}" for n in range(1, 5)] + [f"table-{n}" for n in ("4.1", "5.1", "5.2", "6.1", "6.2", "6.3", "6.4")] + ["example-4.2.2"]
)


def test_every_artefact_of_the_thesis_is_there():
    assert sorted(artefact.name for artefact in ARTEFACTS) == sorted(ALL)
    for artefact in ARTEFACTS:
        for sample in (Sample(), Sample(7), Sample(quick=True)):
            assert all(artefact.setting(sample))
        assert artefact.draw is not None or artefact.name.startswith("table-")


def test_results_are_kept_by_configuration_and_version(tmp_path, coin, monkeypatch):
    sample = Sample(100)
    outcome = coin.compute(sample)
    keep(tmp_path, coin, sample, outcome, 1.5)
    assert read(tmp_path, coin, sample) == (outcome, 1.5)
    assert read(tmp_path, coin, Sample(101)) is None
    with monkeypatch.context() as patch:
        patch.setattr("scripts.reproduce.store.source_checksum", lambda: "another")
        assert read(tmp_path, coin, sample) is None
    (tmp_path / "table-0.1.svg").unlink()
    assert read(tmp_path, coin, sample) is None
    keep(tmp_path, coin, sample, outcome, 1.5)
    (tmp_path / "table-0.1.json").write_text("{")
    assert read(tmp_path, coin, sample) is None


def test_equal_outcomes_make_equal_pictures(tmp_path, coin):
    for name in "ab":
        (tmp_path / name).mkdir()
        keep(tmp_path / name, coin, Sample(100), coin.compute(Sample(100)), 1.0)
    for suffix in (".png", ".svg"):
        assert (tmp_path / "a" / f"table-0.1{suffix}").read_bytes() == (tmp_path / "b" / f"table-0.1{suffix}").read_bytes()


def test_sizes_follow_what_was_asked_for():
    assert [Sample().size(1000), Sample(7).size(1000), Sample(quick=True).size(1000)] == [1000, 7, 50]
    assert [Sample(7).work(200), Sample(7, quick=True).work(200), Sample(quick=True).work(4)] == [200, 10, 4]


def test_the_command_leaves_a_page_and_does_nothing_twice(safe_envs_command, catalogue, computed, tmp_path):
    arguments = ("reproduce", "--episodes", 100, "--jobs", 1, "--out", "report")
    status, out, err = safe_envs_command(*arguments)
    assert (status, err) == (0, "")
    assert "reproduced" in out
    assert "report/index.html" in out
    page = (tmp_path / "report" / "index.html").read_text()
    assert "50.0 %" in page
    assert "[40.4, 59.6]" in page
    assert "48 % (of 50)" in page
    assert "a &lt; b" in page
    assert "data:image/png;base64," in page
    assert "http" not in page
    markdown = (tmp_path / "report" / "index.md").read_text()
    assert "| heads | 48 % (of 50) | 50.0 % | [40.4, 59.6] |" in markdown
    assert "a < b" in markdown
    document = strictly("report/table-0.1.json")
    assert Outcome.from_document(document["outcome"]).numbers[0].ours == 50.0
    assert safe_envs_command(*arguments)[0] == 0
    assert computed == ["table-0.1"]


def test_a_page_says_what_it_rests_on(safe_envs_command, catalogue, tmp_path):
    assert safe_envs_command("reproduce", "--episodes", 100, "--jobs", 1, "--out", "report")[0] == 0
    page, markdown = ((tmp_path / "report" / f"index.{kind}").read_text() for kind in ("html", "md"))
    for text in (page, markdown):
        assert text.index("claim of the thesis") < text.index("it lands") < text.index("check of ours") < text.index("it rolls")
        assert "thrown 100 times" in text
    assert "| it rolls | no | \\|v\\| = 0 |" in markdown
    seconds = strictly("report/table-0.1.json")["seconds"]
    assert f"Computed in {seconds:.0f} s in all" in page


def test_results_of_other_options_are_not_written_over(safe_envs_command, catalogue, computed, tmp_path):
    assert safe_envs_command("reproduce", "--episodes", 100, "--jobs", 1, "--out", "report")[0] == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "report").iterdir()}
    for other in (("--episodes", 101), ("--episodes", 100, "--quick"), ("--episodes", 100, "--seed", 1)):
        status, _, err = safe_envs_command("reproduce", *other, "--jobs", 1, "--out", "report")
        assert status == 2
        assert 'report holds table-0.1 by other options: {"episodes": 100' in err
    assert {path.name: path.read_bytes() for path in (tmp_path / "report").iterdir()} == before
    assert computed == ["table-0.1"]


def test_a_quick_run_has_no_verdict(safe_envs_command, catalogue):
    status, out, _ = safe_envs_command("reproduce", "--quick", "--jobs", 1, "--out", "report")
    assert status == 0
    assert "no verdict, for a quick run" in out
    assert "reproduced" not in out


def test_an_interrupt_ends_a_single_job_at_once(safe_envs_command, catalogue, coin, monkeypatch):
    from dataclasses import replace

    computed = []

    def interrupted(_):
        computed.append(1)
        raise KeyboardInterrupt

    monkeypatch.setattr("scripts.reproduce.catalogue.ARTEFACTS", (replace(coin, name="table-0.2", compute=interrupted), coin))
    status, _, err = safe_envs_command("reproduce", "all", "--jobs", 1, "--out", "report")
    assert status == 130
    assert "Stopped. The same command goes on after what is in report." in err
    assert computed == [1]
    assert not list(Path("report").glob("table*"))


def test_an_interrupt_ends_the_processes(monkeypatch, tmp_path, coin):
    from scripts.reproduce import command

    def interrupted(*_):
        yield "table-0.1", None
        raise KeyboardInterrupt

    context = get_context("spawn")
    process = context.Process(target=time.sleep, args=(600,), daemon=True)
    process.start()
    monkeypatch.setattr(command, "_in_processes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        command._compute([coin, coin], Sample(), tmp_path, 2, print)
    process.join(60)
    assert process.exitcode is not None


def test_a_picture_without_its_numbers_is_not_taken_for_a_result(tmp_path, coin, monkeypatch):
    old = coin.compute(Sample(100))
    keep(tmp_path, coin, Sample(100), old, 1.0)

    def full(*_):
        raise OSError("no room")

    with monkeypatch.context() as patch:
        patch.setattr("scripts.reproduce.store.write_json", full)
        with pytest.raises(OSError, match="no room"):
            keep(tmp_path, coin, Sample(100), old, 1.0)
    assert read(tmp_path, coin, Sample(100)) is None


def test_code_that_changed_during_a_run_is_not_kept(tmp_path, catalogue, computed):
    with pytest.raises(ConfigurationError, match="the code changed during the run"):
        compute_one("table-0.1", Sample(), tmp_path, "another checksum")
    assert not computed
    compute_one("table-0.1", Sample(), tmp_path, source_checksum())
    assert computed == ["table-0.1"]


def test_what_a_lost_process_computed_is_computed_again(tmp_path, monkeypatch):
    from scripts.reproduce import command

    asked = []

    def pooled(names, sample, out, jobs):
        asked.append((list(names), jobs))
        lost = len(names) > 1 or names == ["kills"]
        yield from ((name, BrokenProcessPool() if lost and name != "first" else None) for name in names)

    monkeypatch.setattr(command, "_pooled", pooled)
    ended = dict(command._in_processes(["first", "kills", "beside"], Sample(), tmp_path, 2))
    assert asked == [(["first", "kills", "beside"], 2), (["kills"], 1), (["beside"], 1)]
    assert ended["first"] is ended["beside"] is None
    assert isinstance(ended["kills"], WorkersLostError)


def test_a_run_that_was_stopped_goes_on(safe_envs_command, catalogue, computed, coin, monkeypatch):
    from dataclasses import replace

    def fail(_):
        raise ValueError("no luck")

    other = replace(coin, name="table-0.2", compute=fail)
    monkeypatch.setattr("scripts.reproduce.catalogue.ARTEFACTS", (other, coin))
    status, out, err = safe_envs_command("reproduce", "all", "--jobs", 1, "--out", "report")
    assert status == 2
    assert "table-0.2 failed: ValueError: no luck" in err
    assert "table-0.1" in out
    monkeypatch.setattr("scripts.reproduce.catalogue.ARTEFACTS", (replace(coin, name="table-0.2"), coin))
    status, out, _ = safe_envs_command("reproduce", "table-0.2", "--jobs", 1, "--out", "report")
    assert status == 0
    assert len(computed) == 2
    assert "table-0.1" not in out
    page = Path("report/index.html").read_text()
    assert all(name in page for name in ("table-0.1", "table-0.2"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("table-9.9",), "unknown artefact 'table-9.9'"), (("--out", "file"), "cannot be made"), (("--seed", -1), "seed")],
)
def test_what_it_cannot_take_ends_with_status_2(safe_envs_command, catalogue, tmp_path, arguments, message):
    (tmp_path / "file").write_text("")
    status, _, err = safe_envs_command("reproduce", *arguments)
    assert status == 2
    assert message in " ".join(err.split())


def test_processes_compute_what_a_single_one_does(safe_envs_command, tmp_path):
    """Over real artefacts, the quickest ones."""
    real = {artefact.name: artefact for artefact in ARTEFACTS}
    names = ("figure-6.2", "figure-6.4")
    assert safe_envs_command("reproduce", *names, "--quick", "--jobs", 2, "--out", "by-2")[0] == 0
    for name in names:
        found = strictly(tmp_path / "by-2" / f"{name}.json")["outcome"]
        assert found == json.loads(json.dumps(real[name].compute(Sample(quick=True)).document()))
