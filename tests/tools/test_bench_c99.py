"""That every figure of the C export is there and of something that worked."""

import shutil

import pytest

from bench.c99 import PROGRAMS, rows

needs_programs = pytest.mark.skipif(
    any(shutil.which(name) is None for name in PROGRAMS), reason=f"{', '.join(PROGRAMS)} are needed"
)


@needs_programs
def test_size_and_instructions_are_those_of_a_small_function() -> None:
    found = {(row.name.split("(")[1].split(")")[0], row.name.split(", ")[-1]): row for row in rows(200)}
    assert {kind for kind, _ in found} == {"linear", "gain by sign", "temperature"}
    assert all(10 < row.value < 200 for (_, what), row in found.items() if what == "per frame")
    assert found["linear", "size"].value < 2_000
    assert found["temperature", "size"].value > 241 * 32, "a row for each code of the temperature"
