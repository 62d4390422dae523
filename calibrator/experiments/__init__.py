"""Experiments of the paper, run on any method; each is a function that returns a frozen, JSON-able result."""
