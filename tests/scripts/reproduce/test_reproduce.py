"""`safe-envs reproduce` as a person types it, with an artefact that costs nothing."""

from __future__ import annotations

import errno
import hashlib
import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

from safe_envs.agents.jobs.fingerprint import json_checksum, source_checksum
from safe_envs.agents.jobs.store import ResultStore
from safe_envs.errors import ConfigurationError
from safe_envs.scripts.reproduce.catalogue import ARTEFACTS
from safe_envs.scripts.reproduce.command import ArtefactJob
from safe_envs.scripts.reproduce.framework.artefact import Findings, Workload
from safe_envs.scripts.reproduce.framework.page import write_page
from safe_envs.scripts.reproduce.framework.store import keep, read
from tests.scripts.conftest import strictly
from tests.scripts.reproduce.test_chapter_6 import outcome as outcome_of

pytestmark = pytest.mark.slow

ALL = [
    f"figure-{n}"
    for n in (
        "3.1",
        "3.2a",
        "3.2b",
        "3.3",
        "4.1",
        "4.2",
        "4.3",
        "5.1",
        "5.2",
        "5.3a",
        "5.3b",
        "5.3c",
        "5.3d",
    )
]
ALL += (
    [f"figure-6.{n}" for n in range(1, 5)]
    + [f"table-{n}" for n in ("4.1", "5.1", "5.2", "6.1", "6.2", "6.3", "6.4")]
    + ["example-4.2.2"]
)


def test_every_artefact_of_the_thesis_is_there():
    assert sorted(artefact.name for artefact in ARTEFACTS) == sorted(ALL)
    for artefact in ARTEFACTS:
        for sample in (Workload(), Workload(7), Workload(quick=True)):
            assert all(artefact.setting(sample))
        assert artefact.draw is not None or artefact.name.startswith("table-")


def test_results_are_kept_by_configuration_and_version(tmp_path, coin, monkeypatch):
    sample = Workload(100)
    outcome = coin.compute(sample)
    keep(tmp_path, coin, sample, outcome, 1.5)
    assert read(tmp_path, coin, sample) == (outcome, 1.5)
    assert read(tmp_path, coin, Workload(101)) is None
    with monkeypatch.context() as patch:
        patch.setattr(
            "safe_envs.scripts.reproduce.framework.store.source_checksum", lambda: "another"
        )
        assert read(tmp_path, coin, sample) is None
    (tmp_path / "table-0.1.svg").unlink()
    assert read(tmp_path, coin, sample) is None


def test_equal_outcomes_make_equal_pictures(tmp_path, coin):
    for name in "ab":
        (tmp_path / name).mkdir()
        keep(tmp_path / name, coin, Workload(100), coin.compute(Workload(100)), 1.0)
    for suffix in (".png", ".svg"):
        assert (tmp_path / "a" / f"table-0.1{suffix}").read_bytes() == (
            tmp_path / "b" / f"table-0.1{suffix}"
        ).read_bytes()


def test_sizes_follow_what_was_asked_for():
    assert [Workload().size(1000), Workload(7).size(1000), Workload(quick=True).size(1000)] == [
        1000,
        7,
        50,
    ]
    assert [
        Workload(7).work(200),
        Workload(7, quick=True).work(200),
        Workload(quick=True).work(4),
    ] == [200, 10, 4]


def test_the_command_leaves_a_page_and_does_nothing_twice(
    safe_envs_command, catalogue, computed, tmp_path
):
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
    assert Findings.from_document(document["outcome"]).numbers[0].ours == 50.0
    assert safe_envs_command(*arguments)[0] == 0
    assert computed == ["table-0.1"]


def test_a_page_says_what_it_rests_on(safe_envs_command, catalogue, tmp_path):
    assert safe_envs_command("reproduce", "--episodes", 100, "--jobs", 1, "--out", "report")[0] == 0
    page, markdown = (
        (tmp_path / "report" / f"index.{kind}").read_text() for kind in ("html", "md")
    )
    for text in (page, markdown):
        assert (
            text.index("claim of the thesis")
            < text.index("it lands")
            < text.index("check of ours")
            < text.index("it rolls")
        )
        assert "thrown 100 times" in text
    assert "| it rolls | no | \\|v\\| = 0 |" in markdown
    seconds = strictly("report/table-0.1.json")["seconds"]
    assert f"Computed in {seconds:.0f} s in all" in page


def test_results_of_other_options_are_not_written_over(
    safe_envs_command, catalogue, computed, tmp_path
):
    assert safe_envs_command("reproduce", "--episodes", 100, "--jobs", 1, "--out", "report")[0] == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "report").iterdir()}
    for other in (
        ("--episodes", 101),
        ("--episodes", 100, "--quick"),
        ("--episodes", 100, "--seed", 1),
    ):
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
    computed = []

    def interrupted(_):
        computed.append(1)
        raise KeyboardInterrupt

    monkeypatch.setattr(
        "safe_envs.scripts.reproduce.catalogue.ARTEFACTS",
        (replace(coin, name="table-0.2", compute=interrupted), coin),
    )
    status, _, err = safe_envs_command("reproduce", "all", "--jobs", 1, "--out", "report")
    assert status == 130
    assert "Stopped. The same command goes on after what is in report." in err
    assert computed == [1]
    assert not list(Path("report").glob("table*"))


def test_a_result_that_cannot_be_written_leaves_the_one_before(tmp_path, coin, monkeypatch):
    keep(tmp_path, coin, Workload(100), coin.compute(Workload(100)), 1.0)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "no room")

    with monkeypatch.context() as patch:
        patch.setattr(Figure, "savefig", full)
        with pytest.raises(ConfigurationError, match=r"cannot write .*table-0.1.png: no room"):
            keep(tmp_path, coin, Workload(100), coin.compute(Workload(100)), 2.0)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_picture_without_its_numbers_is_not_taken_for_a_result(tmp_path, coin, monkeypatch):
    keep(tmp_path, coin, Workload(100), coin.compute(Workload(100)), 1.0)

    def full(*_):
        raise ConfigurationError("no room")

    with monkeypatch.context() as patch:
        patch.setattr(ResultStore, "keep", full)
        with pytest.raises(ConfigurationError, match="no room"):
            keep(
                tmp_path,
                replace(coin, draw=lambda figure, _: figure.subplots()),
                Workload(100),
                coin.compute(Workload(100)),
                1.0,
            )
    with pytest.raises(
        ConfigurationError,
        match=r"table-0.1.png is another picture.*remove it, and it is computed again",
    ):
        read(tmp_path, coin, Workload(100))


@pytest.fixture
def kept(tmp_path, coin):
    """The file of a result."""
    keep(tmp_path, coin, Workload(100), coin.compute(Workload(100)), 1.5)
    return tmp_path / "table-0.1.json"


def with_checksum(document):
    """As somebody writes it who knows how."""
    document = {name: value for name, value in document.items() if name != "sha256"}
    return json.dumps({**document, "sha256": json_checksum(document)})


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.just(10**400)
    | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=2)
        | st.dictionaries(st.sampled_from(["numbers", "ours", "name", "x"]), inner, max_size=2)
    ),
    max_leaves=4,
)


@pytest.mark.slow
@given(data=st.data())
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_result_of_another_shape_is_refused_or_shown(data, kept, coin, tmp_path):
    """Even with a checksum that is right."""
    content = kept.read_text()
    document = json.loads(content)
    place: Any = document
    steps = data.draw(st.integers(1, 4))
    for step in range(steps):
        key = data.draw(
            st.sampled_from(sorted(place) if isinstance(place, dict) else list(range(len(place))))
        )
        if step == steps - 1 or not isinstance(place[key], dict | list) or not place[key]:
            place[key] = data.draw(json_values)
            break
        place = place[key]
    try:
        kept.write_text(with_checksum(document))
        with suppress(ConfigurationError):
            found = read(tmp_path, coin, Workload(100))
            if found is not None:
                write_page(tmp_path, [(coin, *found)], Workload(100))
    finally:
        kept.write_text(content)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[1]",
        "[" * 20_000,
        "null",
        '{"configuration": 3}',
        '{"configuration": {}, "x": NaN}',
        "{}",
        "",
    ],
)
def test_what_is_no_result_is_told_before_the_work(
    text, safe_envs_command, catalogue, computed, tmp_path
):
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "table-0.1.json").write_text(text)
    status, _, err = safe_envs_command(
        "reproduce", "--episodes", 100, "--jobs", 1, "--out", "report"
    )
    assert status == 2
    assert "report/table-0.1.json cannot be read" in err
    assert not computed


def test_a_picture_that_is_none_is_told(tmp_path, coin, kept):
    (tmp_path / "table-0.1.png").write_bytes(b"no picture")
    document = json.loads(kept.read_text())
    document["pictures"][".png"] = hashlib.sha256(b"no picture").hexdigest()
    kept.write_text(with_checksum(document))
    found = read(tmp_path, coin, Workload(100))
    assert found is not None
    with pytest.raises(ConfigurationError, match=r"table-0.1.png cannot be read .*remove it"):
        write_page(tmp_path, [(coin, *found)], Workload(100))


def test_code_that_changed_during_a_run_is_not_kept(tmp_path, catalogue, computed):
    job = ArtefactJob("table-0.1", Workload(), tmp_path, "another checksum")
    with pytest.raises(ConfigurationError, match="the code changed during the run"):
        job.compute()
    assert not computed
    replace(job, source=source_checksum()).compute()
    assert computed == ["table-0.1"]


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on(safe_envs_command, catalogue, computed, coin, monkeypatch):
    def fail(_):
        raise ValueError("no luck")

    other = replace(coin, name="table-0.2", compute=fail)
    monkeypatch.setattr("safe_envs.scripts.reproduce.catalogue.ARTEFACTS", (other, coin))
    status, out, err = safe_envs_command("reproduce", "all", "--jobs", 1, "--out", "report")
    assert status == 2
    assert "table-0.2 failed: ValueError: no luck" in err
    assert "table-0.1" in out
    monkeypatch.setattr(
        "safe_envs.scripts.reproduce.catalogue.ARTEFACTS", (replace(coin, name="table-0.2"), coin)
    )
    monkeypatch.setattr(
        "safe_envs.scripts.options.completion.ARTEFACTS", ("table-0.1", "table-0.2")
    )
    status, out, err = safe_envs_command("reproduce", "table-0.2", "--jobs", 1, "--out", "report")
    assert (status, err) == (0, "")
    assert len(computed) == 2
    assert "table-0.1" not in out
    page = Path("report/index.html").read_text()
    assert all(name in page for name in ("table-0.1", "table-0.2"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("table-9.9",), "unknown artefact 'table-9.9'"),
        (("--out", "file"), "cannot be made"),
        (("--seed", -1), "seed"),
    ],
)
def test_what_it_cannot_take_ends_with_status_2(
    safe_envs_command, catalogue, tmp_path, arguments, message
):
    (tmp_path / "file").write_text("")
    status, _, err = safe_envs_command("reproduce", *arguments)
    assert status == 2
    assert message in " ".join(err.split())


@pytest.mark.slow
def test_processes_compute_what_a_single_one_does(safe_envs_command, tmp_path):
    """Over real artefacts, the quickest ones."""
    names = ("figure-6.2", "figure-6.4")
    assert safe_envs_command("reproduce", *names, "--quick", "--jobs", 2, "--out", "by-2")[0] == 0
    for name in names:
        found = strictly(tmp_path / "by-2" / f"{name}.json")["outcome"]
        assert found == json.loads(json.dumps(outcome_of(name).document()))
