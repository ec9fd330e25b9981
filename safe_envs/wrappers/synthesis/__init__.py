"""Polynomial barriers by linear programs: candidates, whose statements others have to prove."""
