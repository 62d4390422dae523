"""Drives: their store, their common time base, and the fleet they make up."""
