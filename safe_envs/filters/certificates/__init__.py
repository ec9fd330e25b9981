"""Barrier certificates: what they state, their files, and the program that checks them."""
