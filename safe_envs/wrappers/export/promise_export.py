"""The files of an exported promise filter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.export.build_files import cmake_text
from safe_envs.wrappers.export.c_names import comment
from safe_envs.wrappers.export.c_numbers import DOUBLE
from safe_envs.wrappers.export.export import ExportOptions, require_own, write_files
from safe_envs.wrappers.export.interface import (
    Interface,
    formula_text,
    quantities_of,
    require_name,
)
from safe_envs.wrappers.export.promise_c_source import promise_source_text
from safe_envs.wrappers.export.promise_header import promise_header, promise_readme, promise_stack
from safe_envs.wrappers.export.promise_reference import (
    PromiseCases,
    decided,
    random_cases,
)
from safe_envs.wrappers.export.promise_selftest import promise_selftest
from safe_envs.wrappers.value.promise_filter import PromiseFilter
from safe_envs.wrappers.value.promise_source import promise_program

LARGEST_TABLES = 2**24
"""Bytes of the tables of an export."""

_GOLDEN = 60


def export_promise(
    promise_filter: PromiseFilter,
    directory: Path | str,
    float32: bool = False,
    options: ExportOptions | None = None,
) -> Interface:
    """Write a promise filter as C99: filter.h, filter.c, selftest.c, CMakeLists.txt and README.md.

    Args:
        promise_filter: the filter.
        directory: where the files are to be; it is created where its parent exists.
        float32: whether the C is to compute in single precision, which a promise does not.
        options: names, units and the region of the golden cases.

    Returns:
        The interface of the exported filter.

    Raises:
        ConfigurationError: The tables are larger than 16 MB; or single precision is asked for; or
            the directory holds other files of these names; or an option is not allowed.
        NotCompilableError: Something in the filter has no form in C, such as a specification.
    """
    if float32:
        raise ConfigurationError(
            "bounds of a promise are rounded outwards in double precision; leave --float32 away"
        )
    folder, options = Path(directory), options or ExportOptions()
    require_own(folder)
    interface, texts = promise_sources(promise_filter, options)
    cases = golden_cases(promise_filter, options)
    texts |= {
        "selftest.c": promise_selftest(interface, cases, decided(promise_filter, cases)),
        "CMakeLists.txt": cmake_text(interface),
        "README.md": promise_readme(interface, promise_filter.look_ahead.steps),
    }
    write_files(folder, texts)
    return interface


def promise_sources(
    promise_filter: PromiseFilter, options: ExportOptions
) -> tuple[Interface, dict[str, str]]:
    """Return the interface of a promise filter, and the texts of its header and its source.

    Args:
        promise_filter: the filter.
        options: names and units.

    Raises:
        ConfigurationError: The name is no name of C, or the tables are larger than 16 MB.
        NotCompilableError: Something in the filter has no form in C.
    """
    require_name(options.name)
    program = promise_program(promise_filter, LARGEST_TABLES)
    problem, units = promise_filter.problem, options.units
    low, high = zip(*problem.box, strict=True)
    interface = Interface(
        options.name,
        comment(f"{replace(promise_filter.settings, table=None).text} for {problem.name}"),
        DOUBLE,
        quantities_of(problem.plant.states, units, {}),
        (),
        quantities_of(problem.plant.inputs, units, {}),
        (),
        tuple(b.name for b in problem.barriers),
        tuple(formula_text(problem.plant.numeric(b.expression)) for b in problem.barriers),
        tuple(map(float, low)),
        tuple(map(float, high)),
        False,
        False,
        program.source.work,
    )
    steps = promise_filter.look_ahead.steps
    return interface, {
        "filter.h": promise_header(interface, steps, promise_stack(interface)),
        "filter.c": promise_source_text(interface, program),
    }


def golden_cases(promise_filter: PromiseFilter, options: ExportOptions) -> PromiseCases:
    """Return a few cases whose decisions a small change of the state does not change.

    Args:
        promise_filter: the filter.
        options: with the region.
    """
    rng = np.random.default_rng(0)
    cases = random_cases(promise_filter, options.region, 8 * _GOLDEN, rng)
    found = decided(promise_filter, cases)
    step = 1e-9 * np.abs(cases.states) * rng.choice([-1.0, 1.0], cases.states.shape)
    other = decided(promise_filter, cases.moved(step))
    steady = (np.abs(found.action - other.action) <= 1e-7).all(axis=1)
    steady &= (np.abs(found.level - other.level) <= 1e-12) & (found.replaced == other.replaced)
    rows = np.flatnonzero(steady)
    # As many of each sort as there are.
    order = np.lexsort((rng.random(len(rows)), _rank(found.replaced[rows], found.level[rows])))
    return cases.at(rows[order[:_GOLDEN]])


def _rank(replaced: np.ndarray, promise: np.ndarray) -> np.ndarray:
    """Return the place of each case among those of its sort."""
    sort = replaced * 2 + (promise > 0.0)
    rank = np.zeros(len(sort), dtype=int)
    for each in np.unique(sort):
        rows = np.flatnonzero(sort == each)
        rank[rows] = np.arange(len(rows))
    return rank
