"""That every figure of the node is there and of something that worked; how large they are is for the benchmarks."""

from pathlib import Path

import pytest

from bench.node import Sizes, measure
from bench.node_plain import plain_job
from bench.node_vehicle import NUMBERS, make_vehicle
from bench.row import Row
from ecu_node.bus.wiring import Mode

TINY = Sizes(repeats=2, frames=600, latency_frames=50, load_frames=3000, process_frames=300, socketcan_frames=0)


@pytest.fixture(scope="module")
def rows() -> dict[str, Row]:
    return {row.name: row for row in measure(TINY)}


def named(rows: dict[str, Row], part: str) -> list[Row]:
    return [row for name, row in rows.items() if part in name]


def test_both_modes_stand_beside_cantools(rows: dict[str, Row]) -> None:
    found = named(rows, "no bus")
    assert [row.name.split(", ")[1] for row in found] == ["overlay", "gateway"]
    assert all(row.unit == "us" and row.ratio is not None and "cantools" in (row.peer or "") for row in found)


@pytest.mark.parametrize("mode", ["gateway", "overlay"])
def test_the_node_on_a_bus_stands_beside_the_bare_loop_and_the_plain_version(rows: dict[str, Row], mode: str) -> None:
    beside = named(rows, f"virtual bus, {mode} beside ")
    assert [(row.peer or "").split(",")[0] for row in beside] == ["bare loop"] * 2 + [f"plain {mode}"] * 2
    assert all(row.value > 0.0 and row.ratio is not None for row in beside)


def test_latencies_of_all_are_in_order(rows: dict[str, Row]) -> None:
    found = named(rows, "latency")
    assert len(found) == 15
    for median, most, nearly_all in zip(found[::3], found[1::3], found[2::3], strict=True):
        assert 0.0 < median.value <= most.value <= nearly_all.value


def test_no_frame_is_lost_at_the_load_of_a_full_bus(rows: dict[str, Row]) -> None:
    assert [row.value for row in (*named(rows, ": lost"), *named(rows, "out of order"))] == [0.0, 0.0]


def test_a_real_process_starts_and_keeps_its_memory(rows: dict[str, Row]) -> None:
    found = named(rows, "ecu-node run")
    assert {row.unit for row in found} == {"s", "MiB"}
    assert all(row.value > 0.0 for row in found if "growth" not in row.name)


def test_the_plain_version_does_the_work_of_the_node(tmp_path: Path) -> None:
    vehicle = make_vehicle(tmp_path, numbered=True)
    job = plain_job(vehicle, Mode.GATEWAY)
    made = [job(payload) for payload in vehicle.frames]
    for ours, other in zip(vehicle.corrected(Mode.GATEWAY), made, strict=True):
        assert other is not None
        assert ours[6:8] == other[6:8]
    assert len(made) == NUMBERS
