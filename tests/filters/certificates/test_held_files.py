"""Files of certificates of held input: exact, tamper-safe, and of the same format."""

from __future__ import annotations

import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.files import load_certificate
from safe_envs.filters.certificates.matching import env_difference
from tests.filters.certificates.held_examples import scalar_certificate, with_numbers
from tests.filters.certificates.test_certificate_files import rewritten, saved


def test_a_file_states_what_was_written(tmp_path) -> None:
    certificate = scalar_certificate()
    assert load_certificate(saved(certificate, tmp_path)) == certificate


def test_each_changed_digit_is_found(tmp_path) -> None:
    path = saved(scalar_certificate(), tmp_path)
    text = path.read_text()
    for i in [i for i, letter in enumerate(text) if letter.isdigit()]:
        path.write_text(text[:i] + str((int(text[i]) + 1) % 10) + text[i + 1 :])
        with pytest.raises(ConfigurationError, match=r"changed|format"):
            load_certificate(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("control", "continuous"),
        ("control", None),
        ("steps", 0),
        ("steps", True),
        ("steps", 10**12),
        ("period", "0"),
        ("sag", "-1"),
        ("tail", 0.5),
        ("m", "-1"),
        ("inputs", [{"name": name, "low": "-1", "high": "1"} for name in ("v", "w")]),
    ],
)
def test_malformed_parts_are_errors(key, value, tmp_path) -> None:
    path = rewritten(saved(scalar_certificate(), tmp_path), lambda c: c.update({key: value}))
    with pytest.raises(ConfigurationError, match=r"psi\.json"):
        load_certificate(path)


def test_a_psi_of_too_many_moments_is_refused(tmp_path) -> None:
    states = [{"name": f"x_{i}", "low": "0", "high": "1"} for i in range(4)]
    large = {"states": states, "drift": ["0"] * 4, "barriers": ["1"], "policy": []}
    large |= {"input_matrix": [["0"]] * 4, "diffusion": [["0"]] * 4}
    large["psi"] = {"center": ["0"] * 4, "scale": ["1"] * 4, "coefficients": [[[3] * 4, "1"]]}
    path = rewritten(saved(scalar_certificate(), tmp_path), lambda c: c.update(large))
    with pytest.raises(ConfigurationError, match="lower degree for held input"):
        load_certificate(path)


def test_the_env_of_a_file_has_its_control_period() -> None:
    assert env_difference(scalar_certificate()).word == "same"
    for options, told in (({"dt": 0.02}, "control period"), ({"substeps": 2}, "substeps")):
        found = env_difference(with_numbers(options={"horizon": 0.5, **options}))
        assert found.word == "differs"
        assert told in found.text
