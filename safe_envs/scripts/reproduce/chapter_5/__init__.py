"""Artefacts of chapter 5 of the thesis."""
