"""What is said of the engine under a table."""

from __future__ import annotations

from safe_envs.scripts.reports.evaluation import engine_notes


def test_the_filters_of_the_compiled_engine_are_named_unless_all_are():
    assert engine_notes([("none", "numpy", 1)]) == []
    (whole,) = engine_notes([("none", "compiled", 1)])
    assert whole == "the steps/s are those of the compiled engine, in one thread."
    (part,) = engine_notes([("none", "numpy", 1), ("scbf", "compiled", 4)])
    assert part == "the steps/s of scbf are those of the compiled engine, in 4 threads."
