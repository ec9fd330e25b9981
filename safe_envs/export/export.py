"""The export of a filter: its options, and the files that it writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import sympy as sp

from safe_envs.dynamics.symbols import declared_sign
from safe_envs.errors import ConfigurationError, NotCompilableError, shortened, shown
from safe_envs.export.c_expressions import DOUBLE, SINGLE
from safe_envs.export.c_files import (
    MARK,
    Interface,
    cmake_text,
    filter_program,
    header_text,
    interface_of,
    readme_text,
    source_text,
)
from safe_envs.export.reference import Region, golden_cases, selftest_text
from safe_envs.files import open_regular, write_atomically, writing
from safe_envs.filters.safety_filter import SafetyFilter

LARGEST_TABLE = 2**21
"""Constants that an export may hold: 16 MB in double precision."""

NAMES = ("filter.h", "filter.c", "selftest.c", "CMakeLists.txt", "README.md")
_SEEN = 200


@dataclass(frozen=True)
class ExportOptions:
    """How a filter is exported.

    Attributes:
        name: with which all public names of C begin.
        units: of states, inputs and measured quantities, by symbol, for comments and tables.
        region: (low, high) of each state, and of each quantity that is measured at run time, from
            which golden cases and comparisons are drawn. By default those of a state are (-2, 2),
            and those of a measured quantity about its default.
    """

    name: str = "safety_filter"
    units: Mapping[str, str] = field(default_factory=dict)
    region: Region = ()


def export_filter(
    safety_filter: SafetyFilter,
    directory: Path | str,
    float32: bool = False,
    options: ExportOptions | None = None,
) -> Interface:
    """Write a filter as C99: filter.h, filter.c, selftest.c, CMakeLists.txt and README.md.

    Args:
        safety_filter: the filter.
        directory: where the files are to be; it is created where its parent exists.
        float32: whether the C computes in single precision.
        options: names, units and the region of the golden cases.

    Returns:
        The interface of the exported filter.

    Raises:
        ConfigurationError: The directory holds files of these names that no export has written, or
            it cannot be written; or an option is not allowed.
        NotCompilableError: Something in the filter has no form in C, such as a table of values.
    """
    folder, options = Path(directory), options or ExportOptions()
    require_own(folder)
    safety_filter = safety_filter.by_constraint()
    interface, texts = sources(safety_filter, float32, options)
    region = region_of(safety_filter, options)
    golden = golden_cases(safety_filter, region, is_single=float32)
    texts |= {
        "selftest.c": selftest_text(interface, *golden),
        "CMakeLists.txt": cmake_text(interface),
        "README.md": readme_text(interface),
    }
    write_files(folder, texts)
    return interface


def write_files(folder: Path, texts: Mapping[str, str]) -> None:
    """Write the files of an export.

    Args:
        folder: where; it is created where its parent exists.
        texts: by the names of `NAMES`.

    Raises:
        ConfigurationError: It cannot be written.
    """
    with writing(folder):
        folder.mkdir(exist_ok=True)
    for name in NAMES:
        content = texts[name].encode()
        write_atomically(folder / name, lambda part, content=content: part.write_bytes(content))


def sources(
    safety_filter: SafetyFilter, float32: bool, options: ExportOptions
) -> tuple[Interface, dict[str, str]]:
    """Return the interface of a filter, and the texts of its header and its source.

    Args:
        safety_filter: the filter.
        float32: whether the C computes in single precision.
        options: names and units.

    Raises:
        ConfigurationError: The name is no name of C.
        NotCompilableError: Something in the filter has no form in C.
    """
    if safety_filter.of_measurements:
        raise NotCompilableError(
            f"the filter has {safety_filter.of_measurements}: estimators and beliefs have no form"
            " in C. Export it without, and give the C your estimate as its state; a bound of its"
            " error is measurement_error=... of the condition"
        )
    program = filter_program(safety_filter)
    size = len(program.data.array())
    if size > LARGEST_TABLE:
        raise ConfigurationError(
            f"the filter has {size} constants, more than {LARGEST_TABLE}; export a smaller network"
        )
    precision = SINGLE if float32 else DOUBLE
    interface = interface_of(
        safety_filter, options.name, precision, options.units, program.source.work
    )
    return interface, {
        "filter.h": header_text(interface),
        "filter.c": source_text(interface, program),
    }


def region_of(safety_filter: SafetyFilter, options: ExportOptions) -> Region:
    """Return the region of golden cases and comparisons.

    Args:
        safety_filter: the filter.
        options: with the region, or without one.

    Raises:
        ConfigurationError: It has the wrong length.
    """
    model, qp = safety_filter.model, safety_filter.qp
    region = list(options.region or ((-2.0, 2.0),) * model.n)
    if len(region) == model.n:
        region += [_about(symbol, model.parameters.get(symbol)) for symbol in qp.runtime]
    if len(region) != len(qp.symbols) or not all(low < high for low, high in region):
        raise ConfigurationError(
            f"region = {shown(list(options.region))}; give (low, high) of each of the {model.n}"
            f" states, and of {', '.join(s.name for s in qp.runtime) or 'nothing else'}"
        )
    return region


def _about(symbol: sp.Symbol, default: float | None) -> tuple[float, float]:
    """Return from where values of a measured quantity are drawn."""
    if default:
        low, high = sorted((0.5 * default, 1.5 * default))
        return low, high
    ends = {"positive": (0.1, 2.0), "nonnegative": (0.0, 2.0), "negative": (-2.0, -0.1)}
    word = declared_sign(symbol) or ""
    return ends.get(word, (-2.0, 0.0) if word == "nonpositive" else (-2.0, 2.0))


def require_own(folder: Path) -> None:
    """Raise ConfigurationError where files would be overwritten that no export has written."""
    if folder.exists() and not folder.is_dir():
        raise ConfigurationError(f"{shortened(folder)} is a file; name a folder")
    foreign = [name for name in NAMES if (folder / name).exists() and not _is_own(folder / name)]
    if foreign:
        raise ConfigurationError(
            f"{shortened(folder)} holds {', '.join(foreign)}, which no export has written; name"
            " another folder, or remove them"
        )


def _is_own(path: Path) -> bool:
    """Return whether an export has written a file."""
    try:
        with open_regular(path) as stream:
            return MARK.encode() in stream.read(_SEEN)
    except OSError:
        return False
