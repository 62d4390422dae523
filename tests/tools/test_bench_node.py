"""That every figure of the node is there and of something that worked; how large they are is for the benchmarks."""

from bench.node import core_rows, process_rows


def test_both_modes_stand_beside_cantools() -> None:
    found = core_rows(2)  # which compares what the two make of each frame
    assert [row.name.split(", ")[1] for row in found] == ["overlay", "gateway"]
    assert all(row.unit == "us" and row.ratio is not None and "cantools" in (row.peer or "") for row in found)


def test_a_real_process_starts_and_keeps_its_memory() -> None:
    found = process_rows(300)
    assert {row.unit for row in found} == {"s", "MiB", "%"}
    assert all(row.value > 0.0 for row in found if "growth" not in row.name)
