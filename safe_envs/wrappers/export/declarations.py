"""Where the variables of a function, which Python does not declare, are declared in C."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple


class Declarations(NamedTuple):
    """Where variables are declared.

    Attributes:
        before: by the id of a statement, the variables that are declared before it.
        inline: by the id of an assignment, the variables that it declares.
        fixed: variables that are assigned once, where they are declared.
    """

    before: dict[int, list[str]]
    inline: dict[int, set[str]]
    fixed: set[str]


class _Occurrence(NamedTuple):
    """A statement that names a variable, with those around it, from the outermost one."""

    blocks: tuple[int, ...]
    statements: tuple[ast.stmt, ...]


def declared(body: Sequence[ast.stmt], parameters: Sequence[str]) -> Declarations:
    """Find the innermost block for each variable that holds all statements that name it.

    Where its first statement there assigns it, that declares it; else it is declared before. The
    counter of a loop belongs to the loop.

    Args:
        body: statements of a function.
        parameters: names of its parameters.

    Returns:
        Where each variable is declared.
    """
    found: dict[str, list[_Occurrence]] = defaultdict(list)
    stores: dict[str, int] = defaultdict(int)
    for name, occurrence, is_store in _occurrences(body, (id(body),), (), frozenset(parameters)):
        found[name].append(occurrence)
        stores[name] += is_store
    result = Declarations(defaultdict(list), defaultdict(set), set())
    for name, occurrences in found.items():
        if not stores[name] or name == "_":
            continue
        depth = _common_depth([o.blocks for o in occurrences])
        first = occurrences[0]
        statement = first.statements[depth - 1]
        if _is_plain_assignment(statement, name):
            result.inline[id(statement)].add(name)
            if stores[name] == 1:
                result.fixed.add(name)
            continue
        # A variable that lives through the rounds of a loop is declared before it.
        loops = [
            k
            for k, s in enumerate(first.statements[: depth - 1])
            if isinstance(s, ast.For | ast.While)
        ]
        outermost = first.statements[loops[0]] if loops else statement
        result.before[id(outermost)].append(name)
    return result


def _occurrences(
    body: Sequence[ast.stmt],
    blocks: tuple[int, ...],
    statements: tuple[ast.stmt, ...],
    hidden: frozenset[str],
) -> Iterator[tuple[str, _Occurrence, bool]]:
    for node in body:
        around = (*statements, node)
        inner = [getattr(node, part, []) for part in ("body", "orelse")]
        within = hidden
        if isinstance(node, ast.For) and isinstance(node.target, ast.Name):
            within = hidden | {node.target.id}
            heads: list[ast.AST] = [node.iter]
        elif isinstance(node, ast.If | ast.While):
            heads = [node.test]
        else:
            heads = [node]
        for head in heads:
            for each in ast.walk(head):
                if isinstance(each, ast.Name) and each.id not in hidden:
                    is_store = isinstance(each.ctx, ast.Store)
                    yield each.id, _Occurrence(blocks, around), is_store
        for k, part in enumerate(inner):
            if part:
                yield from _occurrences(part, (*blocks, id(node) * 2 + k), around, within)


def _common_depth(blocks: Sequence[tuple[int, ...]]) -> int:
    shortest = min(len(b) for b in blocks)
    return next(
        (k for k in range(shortest) if len({b[k] for b in blocks}) > 1),
        shortest,
    )


def _is_plain_assignment(node: ast.stmt, name: str) -> bool:
    """Return whether a statement gives a variable its first value, for which it needs no other."""
    if not isinstance(node, ast.Assign) or _chooses_tuple(node.value):
        return False
    read = {e.id for e in ast.walk(node.value) if isinstance(e, ast.Name)}
    targets = [e for t in node.targets for e in (t.elts if isinstance(t, ast.Tuple) else [t])]
    named = [t for t in targets if isinstance(t, ast.Name) and t.id == name]
    loads = {
        e.id
        for t in targets
        if not isinstance(t, ast.Name)
        for e in ast.walk(t)
        if isinstance(e, ast.Name)
    }
    return bool(named) and name not in read and name not in loads


def _chooses_tuple(value: ast.expr) -> bool:
    return isinstance(value, ast.IfExp) and isinstance(value.body, ast.Tuple)
