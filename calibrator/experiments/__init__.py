"""Experiments of the paper and ours: each is a row of a table, and one function runs each of them with any methods."""
