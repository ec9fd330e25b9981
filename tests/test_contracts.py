"""Rules that neither ruff nor import-linter can check: words, names, docstrings, sizes.

Each test lists every place that breaks its rule. What a word is replaced by stands next to it.
"""

from __future__ import annotations

import ast
import functools
import io
import json
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
THIS = "tests/test_contracts.py"
LOG_OF_CHANGES = "CHANGELOG.md"  # names the old words, to say what replaces them

NAMES = {
    "DriftingEnv": "TiltedNoiseEnv",
    "Exploration": "SamplingDomain",
    "FilterResult": "FilterDecision",
    "Flags": "pair_counts",
    "ForeignWorld": "ExternalTarget",
    "Moment": "EpisodeSnapshot",
    "OwnWorld": "NativeTarget",
    "Place": "Backend",
    "Promised": "GuaranteeAverager",
    "Setting": "EvaluationSpec",
    "SixStep": "CostReturnWrapper",
    "Survey": "SafeSetAnalysis",
    "Totals": "EpisodeStatistics",
    "Wave": "EpisodeBatch",
    "best_length": "optimal_tilt",
    "climbed": "girsanov_integrals",
    "drift_derivative": "lie_derivative_f",
    "input_derivative": "lie_derivative_g",
    "ito_term": "ito_correction",
    "load_problem": "make_problem",
}
"""Retired names, wherever they occur in code or documentation."""

DEFINITIONS = {
    "chosen": "assumptions",
    "corrections": "errata",
    "doubts": "failures",
    "elsewhere": "alternative_settings",
    "kept": "invariant_set",
    "leading": "control_authority",
    "lowest": "minimum, sample_minimum",
    "missed": "max_shortfall",
    "promise": "guarantee, bound",
    "promised": "applicable_bounds",
    "promises": "applicable_bounds, guarantees",
    "spread": "quadratic_variation_rate, standard deviation",
    "survey": "safe_set_analysis",
    "way": "tilt_direction",
}
"""Retired as public names of classes, functions, methods and attributes; local variables may have
them, for they are ordinary words."""

MODULES = {
    "actors": "sb3_actor",
    "blocks": "base",
    "craft": "quadrotor",
    "mistakes": "validation",
    "places": "object_import",
    "statement": "builder",
    "strip": "time_series",
    "weights": "network",
}
"""Retired as names of modules."""

PHRASES = {
    r"anew": "again",
    r"any(body|one) else's": "third-party",
    r"as printed": "the thesis, the printed formula",
    r"bare": "unfiltered",
    r"beside": "next to, with, and",
    r"is told": "receives, is given",
    r"learned anew": "retrained",
    r"least h": "minimum h",
    r"missed by": "violated by",
    r"natural filter": "default filter",
    r"promis(e|es|ed|ing)": "guarantee, bound",
    r"rests? on": "depends on, assumes",
    r"some(body|one) else's": "third-party",
    r"the prints?": "the thesis, the printed formula",
    r"what stands": "name the thing",
}
"""Retired in prose and messages: the subject's own words say it."""

FILTERS = r"safe_envs/wrappers/(?!learning|qp).*|safe_envs/envs/.*|docs/(?!reference).*|README\.md"

LOCAL_PHRASES = {
    # (path, phrase): replacement
    (FILTERS, r"rows?"): "constraint (row only for rows of arrays and tables)",
    (r"(?!safe_envs/wrappers/qp/).*", r"the (physical )?box"): "the input bounds",
    (r"safe_envs/wrappers/(qp|safety_filter|torch_layer).*", r"programs?"): (
        "QP (program only for compiled programs)"
    ),
}
"""Retired in some files only. The solvers in `wrappers.qp` take the rows of a matrix."""

ALLOWED = (
    # (path, text around the word, reason)
    (r".*", r"(dynamic|linear|quadratic|cone|conic|semidefinite|convex) program", "mathematics"),
    (r".*/(value|promise)[^/]*(/.*)?", r"promis", "the name of that filter"),
    (
        r".*",
        r"`?promise`? (filter|policy)|[\"'`{]promise[\"'`:}]|(--| )promise-curriculum|promise:p=",
        "the name of that filter",
    ),
    (
        r".*",
        r"rows? (\([\w, ]+\)|of (an? |the )?(array|matrix|matrices|table|data|log|batch|result))",
        "an array",
    ),
    (
        r".*",
        r"(table|result|matrix|README\.md`?|index\.md`?)('s)? (has |with )?(an? |the )?rows?",
        "a table",
    ),
    (r".*", r"\.rows?\b|\brows?(\.\w|\[|\]|\s*=|_| in (result|answer|evaluate|read))", "code"),
    (r".*", r"[\"']rows?[\"']|for row\b", "code"),
    (
        r".*/(verification|rendering)/.*|.*/sampling_domain\.py",
        r"the box",
        "of states, of a picture",
    ),
)


def sources(*folders: str) -> list[Path]:
    return sorted(
        path
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
        if path.relative_to(ROOT).as_posix() != THIS
    )


def place(path: Path, line: int) -> str:
    return f"{path.relative_to(ROOT).as_posix()}:{line}"


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@functools.cache
def tokens_of(path: Path) -> list[tokenize.TokenInfo]:
    return list(tokenize.generate_tokens(io.StringIO(path.read_text()).readline))


def pages() -> Iterator[tuple[Path, str]]:
    """Yield files of prose with their text."""
    for path in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]):
        if path.name != LOG_OF_CHANGES:
            yield path, path.read_text()
    for path in sorted((ROOT / "docs").rglob("*.ipynb")):
        cells = json.loads(path.read_text())["cells"]
        yield path, "\n".join("".join(cell["source"]) for cell in cells)
    for path in sorted((ROOT / "safe_envs").rglob("*.yaml")):
        yield path, path.read_text()


def prose(phrases: re.Pattern[str]) -> Iterator[tuple[Path, int, str]]:
    """Yield the pages, and comments, docstrings and texts of the sources that have a phrase, with
    their first lines."""
    for path, text in pages():
        yield path, 1, text
    for path in sources("safe_envs", "examples", "docs"):
        # To split a file into tokens takes long.
        if not phrases.search(re.sub(r"\n *# ?", "\n", path.read_text())):
            continue
        comments: list[tuple[int, str]] = []
        for token in tokens_of(path):
            if token.type == tokenize.COMMENT:
                comments.append((token.start[0], token.string.lstrip("# ")))
            elif token.type == tokenize.STRING:
                yield path, token.start[0], token.string
        # A phrase may begin on one line of a comment and end on the next.
        while comments:
            first, text = comments.pop(0)
            last = first
            while comments and comments[0][0] == last + 1:
                last, more = comments.pop(0)
                text += f"\n{more}"
            yield path, first, text


def allowed(path: Path, around: str) -> bool:
    name = path.relative_to(ROOT).as_posix()
    return any(
        re.fullmatch(paths, name) and re.search(text.replace(" ", r"\s+"), around, re.I)
        for paths, text, _ in ALLOWED
    )


def fail_with(found: list[str], rule: str) -> None:
    assert not found, f"{rule} ({len(found)} places)\n" + "\n".join(found)


def test_retired_names_do_not_occur():
    names = "|".join(NAMES)
    found = [
        f"{place(path, token.start[0])}: {token.string} -> {NAMES[token.string]}"
        for path in sources("safe_envs", "examples", "docs", "tests")
        if re.search(rf"\b({names})\b", path.read_text())
        for token in tokens_of(path)
        if token.type == tokenize.NAME and token.string in NAMES
    ]
    # In documentation they count where they are code: most are words of the language as well.
    for path, text in pages():
        for number, line in enumerate(text.splitlines(), 1):
            found += [
                f"{place(path, number)}: {match[1]} -> {NAMES[match[1]]}"
                for match in re.finditer(rf"[`.]({names})\b|\b(?:import|class) ({names})\b", line)
                if match[1]
            ]
    fail_with(found, "retired names")


def test_retired_names_are_not_defined():
    found = []
    for path in sources("safe_envs"):
        if path.stem in MODULES:
            found.append(f"{place(path, 1)}: module {path.stem} -> {MODULES[path.stem]}")
        for node in ast.walk(tree_of(path)):
            names = []
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.append((node.lineno, node.name))
            if isinstance(node, ast.ClassDef):
                names += [
                    (entry.lineno, entry.target.id)
                    for entry in node.body
                    if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name)
                ]
            found += [
                f"{place(path, line)}: {name} -> {DEFINITIONS[name]}"
                for line, name in names
                if name in DEFINITIONS
            ]
    fail_with(found, "retired names are defined")


def test_retired_words_do_not_occur():
    everywhere = {(r".*", phrase): word for phrase, word in PHRASES.items()}
    rules = [
        (
            re.compile(paths),
            re.compile(rf"(?<!`)\b{phrase.replace(' ', chr(92) + 's+')}\b", re.I),
            word,
        )
        for (paths, phrase), word in (everywhere | LOCAL_PHRASES).items()
    ]
    found = []
    for path, first, text in prose(
        re.compile("|".join(rule.pattern for _, rule, _ in rules), re.I)
    ):
        for paths, phrase, word in rules:
            if not paths.fullmatch(path.relative_to(ROOT).as_posix()):
                continue
            for match in phrase.finditer(text):
                if allowed(path, text[max(0, match.start() - 30) : match.end() + 30]):
                    continue
                line = first + text.count("\n", 0, match.start())
                found.append(f'{place(path, line)}: "{" ".join(match[0].split())}" -> {word}')
    fail_with(sorted(found), "retired words")


def test_a_class_name_has_one_meaning():
    places = defaultdict(list)
    for path in sources("safe_envs"):
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(place(path, node.lineno))
    found = [f"{name}: {', '.join(at)}" for name, at in sorted(places.items()) if len(at) > 1]
    fail_with(found, "classes of the same name")


def test_agents_has_at_most_eight_parts():
    parts = [
        path.name
        for path in (ROOT / "safe_envs" / "agents").iterdir()
        if path.name not in ("__init__.py", "__pycache__")
    ]
    assert len(parts) <= 8, sorted(parts)


# --- docstrings -----------------------------------------------------------------------------------

Function = ast.FunctionDef | ast.AsyncFunctionDef


@functools.cache
def classes() -> dict[str, ast.ClassDef]:
    return {
        node.name: node
        for path in sources("safe_envs")
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.ClassDef)
    }


def overrides(owner: ast.ClassDef | None, name: str) -> bool:
    """Return whether a base class of this project has the method, which documents it then."""
    bases = (
        [ast.unparse(base).split("[")[0].split(".")[-1] for base in owner.bases] if owner else []
    )
    return any(
        any(isinstance(entry, Function) and entry.name == name for entry in found.body)
        or overrides(found, name)
        for found in (classes().get(base) for base in bases)
        if found is not None
    )


def public_functions() -> Iterator[tuple[str, ast.ClassDef | None, Function]]:
    """Yield public functions and methods with a docstring, but no properties."""
    for path in sources("safe_envs"):
        for owner in (None, *(n for n in tree_of(path).body if isinstance(n, ast.ClassDef))):
            if owner is not None and owner.name.startswith("_"):
                continue
            for node in (tree_of(path) if owner is None else owner).body:
                if (
                    isinstance(node, Function)
                    and not node.name.startswith("_")
                    and ast.get_docstring(node)
                    and not any("property" in ast.unparse(d) for d in node.decorator_list)
                ):
                    yield f"{place(path, node.lineno)}: {node.name}", owner, node


def arguments_of(node: Function, owner: ast.ClassDef | None) -> list[str]:
    given = node.args
    names = [entry.arg for entry in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    names += [entry.arg for entry in (given.vararg, given.kwarg) if entry]
    static = any("staticmethod" in ast.unparse(d) for d in node.decorator_list)
    return names[1:] if owner is not None and not static else names


def is_command(node: Function) -> bool:
    """Return whether a command line is made of the function: its options have help, and the
    docstring is that of the command."""
    arguments = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
    return any("typer." in ast.unparse(a.annotation) for a in arguments if a.annotation) or any(
        "app." in ast.unparse(d) for d in node.decorator_list
    )


def raised_by(node: Function) -> set[str]:
    """Return the names of errors that the body of a function raises itself, outside any try."""
    found: set[str] = set()

    def visit(entry: ast.AST) -> None:
        for child in ast.iter_child_nodes(entry):
            if isinstance(child, Function | ast.Lambda | ast.ClassDef | ast.Try):
                continue
            if isinstance(child, ast.Raise) and isinstance(child.exc, ast.Call):
                name = ast.unparse(child.exc.func)
                if name.endswith("Error") and name.isidentifier():
                    found.add(name)
            visit(child)

    visit(node)
    return found - {"AttributeError", "NotImplementedError", "AssertionError"}


def test_docstrings_have_the_sections_that_they_need():
    found = []
    for where, owner, node in public_functions():
        text = ast.get_docstring(node) or ""
        if overrides(owner, node.name) or is_command(node) or re.search(r"\b[Ss]ee `", text):
            continue
        arguments = arguments_of(node, owner)
        if len(arguments) >= 2:
            section = text.partition("\nArgs:")[2]
            lacking = [name for name in arguments if not re.search(rf"\b{name}\b", section)]
            if lacking:
                found.append(f"{where}: Args lacks {', '.join(lacking)}")
            nothing = node.returns is None or ast.unparse(node.returns) in ("None", "NoReturn")
            told = re.match(r"(Return|Yield|Make|Build|Create|Load|Parse|Read)", text) or re.search(
                r"^(Returns|Yields):", text, re.M
            )
            if not nothing and not told:
                found.append(f"{where}: lacks Returns")
        unsaid = [name for name in raised_by(node) if name not in text]
        if unsaid:
            found.append(f"{where}: Raises lacks {', '.join(sorted(unsaid))}")
    fail_with(found, "incomplete docstrings")


def test_docstrings_of_functions_begin_with_a_verb():
    # What ruff's D401 does not see, for it knows no such "verbs".
    no_verb = re.compile(
        r"(the|an?|whether|what|that|how|where|which|who|when|if|of|by|as|in|on|for|from|to|one|all"
        r"|each|every|no|not|its|their|such|see:)\b",
        re.IGNORECASE,
    )
    found = [
        f"{where}: {text.splitlines()[0]}"
        for where, _, node in public_functions()
        if (text := ast.get_docstring(node) or "") and no_verb.match(text)
    ]
    fail_with(found, "docstrings without a verb")


# --- names in pages -------------------------------------------------------------------------------


@functools.cache
def definitions() -> set[str]:
    """Return the names of classes, functions and annotated fields, in classes too."""
    found = set()
    for path in sources("safe_envs", "thesis"):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                found.add(node.name)
            elif isinstance(node, ast.AnnAssign):
                found.add(ast.unparse(node.target).removeprefix("self."))
            elif isinstance(node, ast.Assign):
                found |= {ast.unparse(target).removeprefix("self.") for target in node.targets}
    return found


def exists(module: str) -> bool:
    path = ROOT / module.replace(".", "/")
    return path.is_dir() or path.with_suffix(".py").is_file()


def spans_of_code(text: str) -> list[str]:
    return re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))


def test_files_and_attributes_in_pages_exist():
    found = []
    for page in ("CONTRIBUTING.md", "README.md", "docs/architecture.md"):
        for span in spans_of_code((ROOT / page).read_text()):
            if re.fullmatch(r"(safe_envs|tests|docs|examples|scripts)/[\w/.]+(?<!-v0)", span):
                known = "NAME" in span or (ROOT / span).exists()
            elif re.fullmatch(r"[A-Z]\w+[a-z]\.[a-z]\w+(?<!\.md)(?<!\.yaml)", span):
                owner, attribute = span.split(".")
                known = owner in classes() and attribute in definitions()
            else:
                continue
            found += [] if known else [f"{page}: {span}"]
    fail_with(found, "pages name what does not exist")


def test_new_names_of_the_log_of_changes_exist():
    text = (ROOT / LOG_OF_CHANGES).read_text().partition("## 0.1.0")[0]
    rows = re.findall(r"^\| (`.*) \| (.*) \|$", text, re.MULTILINE)
    found, full = [], ""
    for _, new in rows:
        for span in spans_of_code(new):
            name = span.partition("(")[0]
            if name.startswith("safe_envs"):
                known, full = exists(name), name
            elif name.startswith("."):
                # Of the package before it, or of one above.
                parents = [full[: match.start()] for match in re.finditer(r"\.", full)]
                known = any(exists(parent + name) for parent in parents)
            else:
                known = set(name.split(".")) <= definitions()
            found += [] if known else [span]
    assert len(rows) > 30
    fail_with(found, "new names that do not exist")
