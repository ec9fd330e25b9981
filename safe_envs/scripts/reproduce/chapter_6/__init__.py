"""Artefacts of chapter 6 of the thesis."""
