"""How errors end a command."""

from __future__ import annotations

import pytest

from scripts.console import run


def failing(error):
    def command():
        raise error

    return command


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 7.28 TiB for an array with shape [1000000000000]"),
        ValueError("Maximum allowed dimension exceeded"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
    ],
)
def test_sizes_beyond_the_memory_end_with_status_2(capsys, error):
    with pytest.raises(SystemExit) as ended:
        run(failing(error))
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert printed.startswith("Error: not enough memory")
    assert (str(error) or "MemoryError") in printed
    assert "choose smaller settings" in printed


@pytest.mark.parametrize("error", [ValueError("a fault of the program"), RuntimeError("another"), KeyError("x")])
def test_faults_of_the_program_are_not_hidden(error):
    with pytest.raises(type(error)):
        run(failing(error))
