"""Certificates that are part of this package, for registered envs with their default options."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.certificate import BarrierCertificate
from safe_envs.filters.certificates.files import load_certificate
from safe_envs.filters.certificates.matching import problem_differences, system_differences
from safe_envs.problem.problem import SafetyProblem

FOLDER = Path(__file__).parent / "kept"
"""Of files NAME-v0.json, or NAME-v0-ANYTHING.json for other options, after the ids of envs."""


def kept_certificate(problem: SafetyProblem) -> BarrierCertificate:
    """Return the certificate of this package for a problem.

    Args:
        problem: which it has to be of exactly: that of a registered env.

    Raises:
        ConfigurationError: There is none, or none of this problem.
    """
    differing: list[str] = []
    for path in _paths(problem.name):
        certificate = _loaded(path)
        against = differences(certificate, problem)
        if not against:
            return certificate
        differing = differing or against
    reason = (
        f"the one of {problem.name} is for other options, and differs in {', '.join(differing)}"
        if differing
        else f"there is none of {problem.name} (there are: {_names()})"
    )
    raise ConfigurationError(
        f"filter 'certified' needs a certificate, and this package has none of this problem:"
        f" {reason}. Run `safe-envs certify ENV_ID --out psi.json` with the options of this env,"
        " and give certified:file=psi.json"
    )


def is_kept(certificate: BarrierCertificate) -> bool:
    """Return whether a certificate is one of this package."""
    return any(_loaded(path) == certificate for path in _paths(certificate.env_id))


def differences(certificate: BarrierCertificate, problem: SafetyProblem) -> list[str]:
    """Return in what a problem differs from that of a certificate, in words.

    The system of a certificate may be the plant of the problem or its model.

    Args:
        certificate: whose problem is compared.
        problem: that it should be of.
    """
    plant = certificate.plant
    against = system_differences(plant, problem.plant)
    if against and not system_differences(plant, problem.model):
        against = []
    return [*problem_differences(plant, problem), *against]


def _paths(name: str) -> Iterator[Path]:
    """Return the files for an env, given by its id or the name of its problem."""
    wanted = name.rpartition("/")[2].split("-v")[0]
    return (path for path in sorted(FOLDER.glob("*.json")) if path.stem.split("-v")[0] == wanted)


def _names() -> str:
    return ", ".join(sorted({path.stem for path in FOLDER.glob("*.json")})) or "none"


def _loaded(path: Path) -> BarrierCertificate:
    return _read(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _read(path: Path, changed: int) -> BarrierCertificate:
    return load_certificate(path)
