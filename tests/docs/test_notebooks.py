"""The notebooks run anywhere, import what is documented, and what they say is so."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from matplotlib import pyplot as plt

import safe_envs
from safe_envs import agents, plotting, wrappers
from safe_envs.scripts.figures.style import StyledFigure

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def run_cell(source: str, names: dict[str, Any]) -> Any:
    """Execute a cell, and return the value of its last line, if it is an expression."""
    tree = ast.parse(source)
    last = ast.Expression(tree.body.pop().value) if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "<cell>", "exec"), names)
    return eval(compile(last, "<cell>", "eval"), names) if last else None


def code_of(path: Path) -> list[str]:
    cells = json.loads(path.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def own_system(names: dict[str, Any]) -> None:
    """Check what the prose says of numbers that the cells print."""
    certified = "certified:file=yacht.json"
    assert not any(names["lie_derivative_g"](names["yacht"], names["h"]).subs(names["p"], 0))
    bounds = names["found"].guarantee.applicable_bounds(names["starts_of"](names["problem"]), 10.0)
    assert all(bound.value < 0.01 for bound in bounds)
    assert names["lower"] <= 100 * names["best"].lower < names["lower"] + 0.01
    assert names["upper"] - 0.01 < 100 * names["best"].upper <= names["upper"]
    assert names["certification"].mean > 0.9
    assert names["check"](names["certificate"]).word == "checked"
    assert names["nominal"].row(certified).continuous_word == "proved"
    learned = names["learned"]
    assert learned.row("none").ci_high < learned.row(certified).ci_low


CHECKS = {"own-system": own_system}


@pytest.mark.oracle
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_kept_without_outputs_and_runs_in_an_empty_folder(
    path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    text = path.read_text()
    assert '"outputs": []' in text
    assert not re.search(r'"outputs": \[\s*\{', text)
    monkeypatch.chdir(tmp_path)
    # In this process: a kernel of its own imports everything once more. `make docs` executes
    # notebooks in kernels.
    pictures: list[Any] = []
    monkeypatch.setattr(plt, "show", lambda: pictures.extend(plt.get_fignums()))
    names: dict[str, Any] = {}
    for source in code_of(path):
        value = run_cell(source, names)
        if isinstance(value, StyledFigure):
            pictures.append(value)
    plt.close("all")
    assert pictures
    CHECKS.get(path.stem, lambda _: None)(names)


def sources() -> Iterator[tuple[str, str]]:
    """Yield all Python that is shown to users, with the name of its file."""
    for page in PAGES:
        for block in re.findall(r"^```python[^\n]*\n(.*?)^```", page.read_text(), re.M | re.S):
            yield page.name, block
    for path in NOTEBOOKS:
        for cell in code_of(path):
            yield path.name, cell
    for path in EXAMPLES:
        yield path.name, path.read_text()


def test_what_is_shown_to_users_imports_what_the_reference_documents():
    pages = (page.read_text() for page in (DOCS / "reference").glob("*.md"))
    documented = set(re.findall(r"^::: (\S+)$", "".join(pages), re.MULTILINE))
    packages = (safe_envs, agents, wrappers)
    documented |= {f"{each.__name__}.{name}" for each in packages for name in each.__all__}
    undocumented = set()
    for where, source in sources():
        for node in ast.walk(ast.parse(source)):
            if not isinstance(node, ast.ImportFrom) or not str(node.module).startswith("safe_envs"):
                continue
            for alias in node.names:
                module, name = str(node.module), alias.name
                value = getattr(import_module(module), name)
                home = f"{getattr(value, '__module__', '')}.{getattr(value, '__name__', name)}"
                if not {module, f"{module}.{name}", home} & documented:
                    undocumented.add(f"{where}: {module}.{name}")
    assert not undocumented


def test_everything_that_plots_is_in_the_reference():
    page = (DOCS / "reference" / "plotting.md").read_text()
    assert all(f"safe_envs.plotting.{name}" in page for name in plotting.__all__)


def test_what_is_shown_to_users_needs_no_module_of_the_command_line():
    assert not [where for where, source in sources() if "safe_envs.scripts" in source]
