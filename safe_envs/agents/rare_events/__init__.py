"""Probabilities of rare violations, by multilevel splitting and importance sampling."""
