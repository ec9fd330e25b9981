"""The figures, tables and examples of the thesis next to ours: `python -m thesis`."""
