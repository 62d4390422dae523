from bench.ingest import rows


def test_both_ways_of_reading_give_the_same_channels_and_a_figure_each() -> None:
    blf, candump, summaries = rows(quick=True)  # compares the channels of both ways
    assert [row.unit for row in (blf, candump, summaries)] == ["frames/s", "frames/s", "h/s"]
    for row in (blf, candump):
        assert row.peer is not None
        assert row.ratio is not None
        assert row.ratio > 1.0
    assert summaries.value > 0.0
