"""The export of a filter: its options, and the files that it writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import sympy as sp

from safe_envs.dynamics.symbols import declared_sign
from safe_envs.errors import ConfigurationError, NotCompilableError, shortened, shown
from safe_envs.export.interface import Interface
from safe_envs.export.program import MARK, exported, rendered
from safe_envs.export.reference import Region, golden_cases
from safe_envs.files import open_regular, write_atomically, writing
from safe_envs.filters.safety_filter import SafetyFilter

NAMES = ("filter.h", "filter.c", "filter_core.c", "selftest.c", "CMakeLists.txt", "README.md")
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
    """Write a filter as C99: filter.h, filter.c, filter_core.c and what belongs to them.

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
        NotCompilableError: Something in the filter has no form in C, such as an estimator.
    """
    folder, options = Path(directory), options or ExportOptions()
    if not isinstance(safety_filter, SafetyFilter):
        raise NotCompilableError(
            f"a {type(safety_filter).__name__} has no form in C; export a SafetyFilter"
        )
    _require_own(folder)
    safety_filter = safety_filter.by_constraint()
    interface, texts = exported(safety_filter, float32, options.name, options.units)
    golden = golden_cases(safety_filter, region_of(safety_filter, options), is_single=float32)
    texts["selftest.c"] = rendered("selftest.c", interface, golden=golden)
    texts |= {name: rendered(name, interface) for name in ("CMakeLists.txt", "README.md")}
    with writing(folder):
        folder.mkdir(exist_ok=True)
    for name, text in texts.items():
        content = text.encode()
        write_atomically(folder / name, lambda part, content=content: part.write_bytes(content))
    return interface


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
    ends = {
        "positive": (0.1, 2.0),
        "nonnegative": (0.0, 2.0),
        "negative": (-2.0, -0.1),
        "nonpositive": (-2.0, 0.0),
    }
    return ends.get(declared_sign(symbol) or "", (-2.0, 2.0))


def _require_own(folder: Path) -> None:
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
