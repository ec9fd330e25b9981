"""Files of results are there whole or not at all."""

from __future__ import annotations

import pytest

from safe_envs import ConfigurationError
from safe_envs.files import require_writable, write_atomically


def test_a_file_is_written_and_replaced(tmp_path):
    path = tmp_path / "out.json"
    for text in ("first", "second"):
        write_atomically(path, lambda part, text=text: part.write_text(text))
        assert path.read_text() == text
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("before", [None, "old"])
def test_a_failure_leaves_what_was_there(tmp_path, error, before):
    path = tmp_path / "out.json"
    if before:
        path.write_text(before)

    def half(part):
        assert part.parent == path.parent
        assert part.suffix == ".json"
        part.write_text("half")
        raise error

    with pytest.raises(error):
        write_atomically(path, half)
    assert [p.read_text() for p in tmp_path.iterdir()] == ([before] if before else [])


def test_places_that_cannot_be_written_are_named(tmp_path):
    for path in (tmp_path, tmp_path / "no" / "file.json"):
        with pytest.raises(ConfigurationError, match="cannot write"):
            require_writable(path)
        with pytest.raises(ConfigurationError, match="cannot write"):
            write_atomically(path, lambda part: part.write_text("x"))
    (tmp_path / "plain").touch()
    for path in (tmp_path / "plain" / "file.json", tmp_path / "plain" / "no" / "file.json"):
        with pytest.raises(ConfigurationError, match="plain is a file and no folder"):
            require_writable(path)
    (tmp_path / "plain").unlink()
    require_writable(tmp_path / "file.json")
    assert list(tmp_path.iterdir()) == []
