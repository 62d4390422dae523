"""Experiments of the paper and ours: each is a row of a table, run by one runner with any methods."""
