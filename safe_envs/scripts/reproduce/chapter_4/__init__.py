"""Artefacts of chapter 4 of the thesis."""
