"""Hypothesis in the copy that is changed: the same examples each time, no search for the smallest, and no clock."""

from hypothesis import Phase, settings

settings.register_profile(
    "mutants", phases=[Phase.explicit, Phase.generate], derandomize=True, database=None, deadline=None
)
settings.load_profile("mutants")
