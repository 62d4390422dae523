import pytest

from bench.ingest import rows


@pytest.mark.long
def test_both_ways_of_reading_give_the_same_channels_and_a_figure_each() -> None:
    found = {row.name: row for row in rows(quick=True)}  # compares the channels of both ways
    assert [row.unit for row in found.values()] == ["frames/s"] * 4 + ["h/s"] * 6
    assert all(row.value > 0.0 for row in found.values())
    for name in ("BLF", "candump", "ASC"):
        ratio = found[f"{name} log to drive"].ratio
        assert ratio is not None
        assert ratio > 1.0
