"""That every figure of the C export is there and of something that worked."""

import shutil

import pytest

from bench.c99 import PROGRAMS, rows

needs_programs = pytest.mark.skipif(
    any(shutil.which(name) is None for name in PROGRAMS), reason=f"{', '.join(PROGRAMS)} are needed"
)


@needs_programs
def test_size_and_instructions_are_those_of_a_small_function() -> None:
    found = [(row.name.split(", ")[-1], row.value) for row in rows(200)]
    assert [what for what, _ in found] == ["size", "per frame"] * 2
    assert all(10 < value < 200 for what, value in found if what == "per frame")
    assert all(100 < value < 2_000 for what, value in found if what == "size")
