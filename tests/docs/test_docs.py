"""The documentation: a page for each env and condition, valid commands, examples that run."""

from __future__ import annotations

import base64
import json
import os
import re
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any

import nbformat
import PIL.Image
import pytest
import yaml

import safe_envs
from safe_envs import ENV_IDS, agents, wrappers
from safe_envs.agents.rare_events.estimate import estimate_rare
from safe_envs.registry import make_problem
from safe_envs.wrappers import CONDITIONS, LEARNED

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
WITH_PYTHON = [page for page in PAGES if "```python" in page.read_text()]


def name_of(path: Path) -> str:
    return path.relative_to(DOCS).as_posix()


@pytest.fixture
def hook(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a module that makes the site; mkdocs itself is not needed."""
    monkeypatch.syspath_prepend(DOCS / "hooks")
    return import_module


@pytest.fixture
def pages_in_navigation(hook: Any) -> list[str]:
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    hook("navigation").complete(nav)
    return list(leaves(nav))


def leaves(nav: Any) -> Iterator[str]:
    if isinstance(nav, str):
        yield nav
    else:
        for entry in nav.values() if isinstance(nav, dict) else nav:
            yield from leaves(entry)


def test_every_env_and_condition_has_a_page(pages_in_navigation: list[str]):
    assert {f"envs/{env_id.split('/')[1].removesuffix('-v0')}.md" for env_id in ENV_IDS} <= set(
        pages_in_navigation
    )
    for name in (*CONDITIONS, *LEARNED, "certified"):
        assert f"filters/{name}.md" in pages_in_navigation
        assert (DOCS / "filters" / f"{name}.md").is_file()


def test_every_page_is_in_the_navigation(pages_in_navigation: list[str]):
    notebooks = {f"notebooks/{path.stem}.md" for path in (DOCS / "notebooks").glob("*.ipynb")}
    written = {name_of(page) for page in PAGES} | notebooks
    made = {"reference/command-line.md", "reference/info.md"}
    assert written <= set(pages_in_navigation)
    assert {page for page in pages_in_navigation if not page.startswith("envs/")} <= written | made


@pytest.mark.parametrize("name", [*CONDITIONS, *LEARNED, "certified"])
def test_page_of_a_condition_has_equation_guarantee_and_example(name: str, hook: Any):
    text = (DOCS / "filters" / f"{name}.md").read_text()
    assert re.match(rf"# [A-Z][a-z-]+ .* \(.+\)\n\nName: `{name}`.*\n\n\$\$", text)
    assert "**Source.** " in text
    assert all(
        f"**{part}" in text for part in ("When to use.", "Guarantee.", "Outside its assumptions.")
    )
    filters = [word.split(":")[0] for words in hook("runs").commands_in(text) for word in words]
    assert name in filters


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_exist(page: Path, hook: Any):
    known = hook("commands")
    for _, name, *words in hook("runs").commands_in(page.read_text()):
        assert name in known.commands()
        options = {word.split("=")[0] for word in words if word.startswith("--")}
        assert options <= known.options_of(known.commands()[name])


def test_page_of_the_command_line_has_every_option(hook: Any):
    known = hook("commands")
    page = known.command_line_page()
    for name, command in known.commands().items():
        section = page.split(f"\n## {name}\n")[1].split("\n## ")[0]
        assert all(option in section for option in known.options_of(command) - {"--help"})


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[] if page.stem == "extend" else pytest.mark.oracle)
        for page in WITH_PYTHON
    ],
    ids=name_of,
)
def test_python_runs(page: Path, hook: Any, monkeypatch: pytest.MonkeyPatch):
    # What is printed is looked at when the site is built; here it is to run.
    for size, few in (("particles", 50), ("repetitions", 10)):
        monkeypatch.setitem(estimate_rare.__kwdefaults__, size, few)
    hook("runs").run_python(page.read_text())


@pytest.mark.slow
def test_notebooks_are_executed_in_a_kernel_and_shown_with_their_outputs(hook: Any, tmp_path: Path):
    notebooks, pixel = hook("notebooks"), base64.b64encode(b"\x89PNG of a pixel").decode()
    cells = [
        nbformat.v4.new_markdown_cell("# A title"),
        nbformat.v4.new_code_cell("print(6)\nprint(7)\n6 * 7"),
        nbformat.v4.new_code_cell(
            f"from IPython.display import display\ndisplay({{'image/png': '{pixel}'}}, raw=True)"
        ),
    ]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "small.ipynb")
    pages = notebooks.notebook_pages(tmp_path / "small.ipynb")
    assert "```text\n6\n7\n```\n\n```text\n42\n```" in pages["notebooks/small.md"]
    assert pages["notebooks/small-2-0.png"] == b"\x89PNG of a pixel"


@pytest.mark.parametrize(
    "package", [safe_envs, wrappers, agents], ids=lambda package: package.__name__
)
def test_everything_public_is_in_the_reference(package: Any):
    shown = set(
        re.findall(
            r"^::: (\S+)$",
            "".join(page.read_text() for page in (DOCS / "reference").glob("*.md")),
            re.MULTILINE,
        )
    )
    written = (DOCS / "reference" / "envs.md").read_text()
    for name in package.__all__:
        module = getattr(getattr(package, name), "__module__", "")
        ours = {each for each in shown if each.startswith("safe_envs.")}
        places = {each for each in ours if each.endswith(f".{name}")} | {f"{module}.{name}", module}
        assert places & shown or f"`{package.__name__}.{name}`" in written, name


def test_formulas_of_docstrings_become_latex(hook: Any):
    latex_of = hook("formulas").latex_of
    assert latex_of("h = r^2 - x_1^2") == "h = r^{2} - x_{1}^{2}"
    assert latex_of("2 v/(a b)") == r"2\, v/\left(a\, b\right)"
    assert latex_of("2 v/(a b)", display=True) == r"\frac{2\, v}{a\, b}"
    assert latex_of("(a + b)/c d", display=True) == r"\frac{a + b}{c}\, d"
    assert latex_of("(a) (b)/c", display=True) == r"\frac{\left(a\right)\, \left(b\right)}{c}"
    assert latex_of("exp(-.5 thetadot) <= 3e-5") == (
        r"\exp\left({-0.5\, \dot{\theta}}\right) \leq 3 \cdot 10^{-5}"
    )
    assert latex_of("z_ref = abs(x' P)") == r"z_{\mathrm{ref}} = \lvert x^\top\, P \rvert"
    for wrong in ("a +", "(a", "a ? b", "a) b", "="):
        with pytest.raises(ValueError, match=r"has|is"):
            latex_of(wrong)


def test_pages_of_envs_have_each_equation_once_and_in_mathematics(hook: Any):
    pages = hook("environments").env_pages()
    for env_id in ENV_IDS:
        name = env_id.split("/")[1].removesuffix("-v0")
        page = pages[f"envs/{name}.md"]
        assert re.match(rf"# .+ \({name}\)\n", page)
        prose = re.sub(r"```.*?```|\$\$.*?\$\$|\$.*?\$|`[^`]*`", "", page, flags=re.DOTALL)
        assert not re.search(
            r"\^|theta|sqrt\(|exp\(|[a-z]_[a-z0-9]\b", re.sub(r"\(.*?\)", "", prose)
        )
        equations = page.split("## Equations")[1].split("## States")[0]
        assert equations.count("$$\nd") == len(make_problem(env_id).plant.states)
        assert page.split("## Barrier")[1].split("## Noise")[0].count("$$") in (0, 2)
        assert {f"envs/{name}.png", f"envs/{name}-narrow.png"} <= set(pages)


def test_the_repository_is_that_of_the_project_file(hook: Any, tmp_path: Path):
    repository, config = hook("repository"), SimpleNamespace(repo_url="https://example.org/me")
    text = "before <!-- link to the repository -->"
    assert "[Repository](https://example.org/me)" in repository.on_page_markdown(text, config)
    assert repository.on_page_markdown(text, SimpleNamespace(repo_url=None)) == "before "
    (tmp_path / "pyproject.toml").write_text('[project.urls]\nRepository = "https://a.b/c"\n')
    assert repository.repository_url(tmp_path / "pyproject.toml") == "https://a.b/c"


def test_the_animation_of_the_home_page_is_small_and_has_a_still_for_reduced_motion():
    film, still = (DOCS / "assets" / f"compare.{suffix}" for suffix in ("gif", "png"))
    assert film.stat().st_size <= 400_000
    with PIL.Image.open(film) as moving, PIL.Image.open(still) as last:
        assert moving.size == last.size
        assert getattr(moving, "n_frames", 1) > 10
    for page, folder in ((DOCS / "index.md", ""), (ROOT / "README.md", "docs/")):
        picture = page.read_text().split("<picture>")[1].split("</picture>")[0]
        assert f'<img src="{folder}assets/compare.gif"' in picture
        assert (
            f'srcset="{folder}assets/compare.png" media="(prefers-reduced-motion: reduce)"'
            in picture
        )


def test_abbreviations_are_in_the_glossary():
    glossary = (DOCS / "glossary.md").read_text()
    for short in re.findall(
        r"^\*\[(\w+?)s?\]", (DOCS / "assets/abbreviations.txt").read_text(), re.M
    ):
        assert re.search(rf"^\| {short} \|", glossary, re.MULTILINE), short


def test_citations_are_the_same_everywhere():
    cff = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    entries = re.findall(r"```bibtex\n(.*?)```", (DOCS / "citing.md").read_text(), re.DOTALL)
    readme = (ROOT / "README.md").read_text()
    assert len(entries) == 2
    assert all(entry in readme for entry in entries)
    assert cff["title"] in entries[0]
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert cff["version"] == version
    assert f"{{{version}}}" in entries[0]
    (thesis,) = (work for work in cff["references"] if work["type"] == "thesis")
    assert thesis["title"] in entries[1]
    assert thesis["authors"][0]["family-names"] in entries[1]


def test_references_exist():
    missing = []
    for page in sorted((DOCS / "reference").glob("*.md")):
        for path in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE):
            try:
                resolve_name(path)
            except (ImportError, AttributeError):
                missing.append(f"{name_of(page)}: {path}")
    assert not missing


def test_what_an_example_prints_follows_it(hook: Any):
    runs = hook("runs")
    page = (
        "```python run\nprint(6 * 7)\n```\n\ntext\n\n```console run fails\n$ safe-envs evaluate"
        " safe_envs/Nothing-v0\n```\n"
    )
    shown = runs.with_output(page)
    assert shown.startswith("```python\nprint(6 * 7)\n```\n\n```text\n42\n```\n\ntext")
    assert "```console\n$ safe-envs evaluate safe_envs/Nothing-v0\n```\n\n```" in shown
    assert "\nError: " in shown
    with pytest.raises(RuntimeError, match="status 2"):
        runs.with_output(page.replace(" fails", ""))


@pytest.mark.parametrize("variable", ["FORCE_COLOR", "TTY_COMPATIBLE"])
def test_pages_have_no_colours_of_terminals(
    hook: Any, monkeypatch: pytest.MonkeyPatch, variable: str
):
    runs, page = hook("runs"), "```console run\n$ safe-envs list\n```\n"
    plain = runs.with_output(page)
    monkeypatch.setenv(variable, "1")
    assert runs.with_output(page) == plain
    assert "\x1b" not in plain
    assert os.environ[variable] == "1"


def test_wide_commands_and_outputs_fit_a_page(hook: Any):
    runs = hook("runs")
    options = " ".join(f"--filter hocbf:alpha={k}" for k in range(8))
    page = f"```console run fails\n$ safe-envs evaluate safe_envs/Nothing-v0 {options}\n```\n"
    shown = runs.with_output(page)
    command = shown.split("```")[1].removeprefix("console\n$ ")
    assert all(len(line) <= 96 for line in command.splitlines())
    assert " ".join(command.replace("\\\n", " ").split()) == (
        f"safe-envs evaluate safe_envs/Nothing-v0 {options}"
    )
    assert "```{.text .wrapped}\n" + "x" * 97 in runs.with_output(
        "```python run\nprint('x' * 97)\n```\n"
    )


def test_table_of_attainable_safety_says_what_commands_wrote(hook: Any, tmp_path: Path):
    table, folder, kept = hook("attainable"), tmp_path / "found", tmp_path / "kept.json"
    folder.mkdir()
    best = {"lower": 0.9, "upper": 0.95, "simulated": 0.93, "simulated_interval": [0.91, 0.94]}
    best |= {"contradiction": None, "coordinates": ["x"], "cells": [40], "steps": 5}
    best |= {"seconds": 2.0, "memory": 3e6}
    unround = best | {"lower": 0.99996, "upper": 0.999961}
    rows = [
        {"filter": "none", "safety_rate": 0.1, "ci_low": 0.0, "ci_high": 0.2},
        {"filter": "scbf", "safety_rate": 0.5, "ci_low": 0.4, "ci_high": 0.6},
    ]
    written = {
        "Close": best,
        "Coarse": best | {"lower": 0.0, "upper": 1.0},
        "Doubtful": best | {"contradiction": "too high", "lower": None, "upper": None},
        "Large": {"rows": rows},
        "Outwards": unround,
    }
    for name, document in written.items():
        (folder / f"{name}.json").write_text(json.dumps(document))
    table.taken_over(folder, kept)
    values, grids = (part.splitlines()[2:] for part in table.attainable_table(kept).split("\n\n"))
    assert "| 90.00 % | 95.00 % | 93.0 % [91.0, 94.0] | best |" in values[0]
    assert "| 0 (grid too coarse) | 1 (grid too coarse) |" in values[1]
    assert "| withheld | withheld |" in values[2]
    assert "| no grid | no grid | 50.0 % [40.0, 60.0] | `scbf` |" in values[3]
    assert "| 99.996 % | 99.997 % |" in values[4]
    assert {line.count("|") for line in values} == {6}
    assert [line.split("|")[2:] for line in grids] == [
        [" `x` ", " 40 ", " 5 ", " 2 s ", " 3 MB ", ""]
    ] * 4


def test_attainable_safety_is_that_of_envs_of_this_project(hook: Any):
    entries = json.loads(hook("attainable").KEPT.read_text())
    assert {f"safe_envs/{name}-v0" for name in entries} <= set(ENV_IDS)
