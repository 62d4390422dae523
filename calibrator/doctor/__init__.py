"""Examination of a user's layout and logs: what can be used, and what is wrong."""
