"""Rules that neither ruff nor import-linter can check; each test lists what breaks one."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
from collections import defaultdict
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("safe_envs", "safe_envs.agents", "safe_envs.testing", "safe_envs.wrappers")


def test_a_class_name_has_one_meaning():
    places = defaultdict(list)
    for path in sorted((ROOT / "safe_envs").rglob("*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert {name: at for name, at in places.items() if len(at) > 1} == {}


@pytest.mark.parametrize("name", PACKAGES)
def test_public_names_resolve_and_say_what_they_take_and_raise(name: str):
    package = import_module(name)
    assert len(set(package.__all__)) == len(package.__all__)
    assert {*package.__all__} <= {*dir(package)}
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = package.no_such_name
    found = []
    for public in package.__all__:
        each = getattr(package, public)
        if not (inspect.isclass(each) or inspect.isfunction(each)):
            continue
        text = inspect.getdoc(each) or ""
        if not text:
            found.append(f"{public}: no docstring")
        if inspect.isfunction(each) and not re.search(r"\b[Ss]ee `", text):
            arguments = [each for each in inspect.signature(each).parameters if each != "self"]
            lacking = [one for one in arguments if not re.search(rf"\b{one}\b", text)]
            found += [f"{public}: {one} is not described" for one in lacking * (len(arguments) > 1)]
            raised = set(re.findall(r"^    raise (\w+Error)", inspect.getsource(each), re.M))
            found += [f"{public}: {one} is not named" for one in raised if one not in text]
    assert found == []


def tracked() -> list[Path]:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    done = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / name for name in done.stdout.split("\0") if name]


def test_no_file_names_a_place_of_one_machine():
    own = re.compile(r"/(?:home|Users|root|work)/[a-z]\w*/")
    found = [
        f"{path.relative_to(ROOT)}:{number}: {match[0]}"
        for path in tracked()
        if path.suffix in (".cfg", ".ipynb", ".json", ".md", ".py", ".sh", ".toml", ".yaml", ".yml")
        and path.is_file()
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if (match := own.search(line))
    ]
    assert found == []


def test_files_that_pages_name_exist():
    pages = [ROOT / name for name in ("CONTRIBUTING.md", "README.md", "docs/architecture.md")]
    spans = re.compile(r"`((?:safe_envs|tests|docs|examples|thesis|benchmarks)/[\w/.]+(?<!-v0))`")
    named = {name for page in pages for name in spans.findall(page.read_text())}
    assert sorted(name for name in named if "NAME" not in name and not (ROOT / name).exists()) == []
