"""What docs/fault_table.md says of faults, where no other test shows it; and that each test it names exists."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.core.corrector import Corrector
from ecu_node.core.signals import FrameKey
from ecu_node.core.status import Counters
from ecu_node.database import VehicleDatabase
from tests.ecu_node.vehicles import Frame, answers, parameters_for, passed_on, protected

TABLE = Path(__file__).parents[2] / "docs" / "fault_table.md"
TESTS = Path(__file__).parents[1]
BATTERY = FrameKey(0x110, False)


def corrector_for(database: VehicleDatabase, mode: Mode) -> Corrector:
    parameters = parameters_for(database, battery=(0.25, 5.0))
    return wire(database, InForce(parameters=parameters), start_s=0.0, mode=mode)


def used(database: VehicleDatabase, mode: Mode, frames: Sequence[bytes]) -> tuple[list[bool], Counters]:
    """Which of these battery frames are answered by an overlay node, or passed on by a gateway; what is counted."""
    corrector = corrector_for(database, mode)
    take: Callable[[Corrector, Frame, float], object] = answers if mode is Mode.OVERLAY else passed_on
    return [bool(take(corrector, Frame(BATTERY, data), 0.02 * k)) for k, data in enumerate(frames)], corrector.counters


def battery(database: VehicleDatabase, *counters: int) -> list[bytes]:
    return [protected(database, "HV_Battery", counter, BatteryCurrent=100.0) for counter in counters]


@pytest.mark.parametrize("mode", Mode)
def test_after_a_lost_frame_the_next_one_is_used(database: VehicleDatabase, mode: Mode) -> None:
    found, counters = used(database, mode, battery(database, 0, 1, 3, 4, 7))
    assert found == [True] * 5
    assert counters.gaps == 2


@pytest.mark.parametrize("mode", Mode)
def test_a_repeated_frame_is_used_once(database: VehicleDatabase, mode: Mode) -> None:
    found, counters = used(database, mode, battery(database, 0, 1, 1, 2))
    assert found == [True, True, False, True]
    assert (counters.repeated, counters.held_back) == (1, 0 if mode is Mode.OVERLAY else 1)


@pytest.mark.parametrize("mode", Mode)
def test_a_frame_whose_counter_jumps_is_not_used_but_the_next_one_is(database: VehicleDatabase, mode: Mode) -> None:
    found, counters = used(database, mode, battery(database, 0, 1, 9, 10))
    assert found == [True, True, False, True]
    assert (counters.jumped, counters.gaps) == (1, 0)


@pytest.mark.parametrize("mode", Mode)
def test_a_frame_with_a_wrong_crc_is_as_if_it_had_not_come(database: VehicleDatabase, mode: Mode) -> None:
    first, second, third = battery(database, 0, 1, 2)
    damaged = second[:2] + bytes([second[2] ^ 0x10]) + second[3:]
    found, counters = used(database, mode, [first, damaged, second, third, b""])
    assert found == [True, False, True, True, False]
    assert (counters.corrupt, counters.gaps, counters.repeated) == (2, 0, 0)


def test_every_row_names_tests_and_every_test_exists() -> None:
    defined = {
        name for path in TESTS.rglob("test_*.py") for name in re.findall(r"(?m)^def (test_\w+)", path.read_text())
    }
    rows = [
        line for line in TABLE.read_text().splitlines() if line.startswith("| ") and not line.startswith("| fault |")
    ]
    named = [re.findall(r"`(test_\w+)`", line.rsplit("|", 2)[1]) for line in rows]
    assert len(rows) >= 25
    assert [row for row, names in zip(rows, named, strict=True) if not names] == []
    assert {name for names in named for name in names} - defined == set()
