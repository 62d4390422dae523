"""Drives: their store, their common time base, and their delays."""
