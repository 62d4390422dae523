"""What docs/fault_table.md says of faults, where no other test shows it."""

from collections.abc import Callable, Sequence

import pytest

from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.core.corrector import Corrector
from ecu_node.core.signals import FrameKey
from ecu_node.core.status import Counters
from ecu_node.database import VehicleDatabase
from tests.ecu_node.vehicles import Frame, answers, parameters_for, passed_on, protected

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
@pytest.mark.parametrize(
    ("sent", "unused", "counted"),
    [((0, 1, 3, 4, 7), None, "gaps 2"), ((0, 1, 1, 2), 2, "repeated 1"), ((0, 1, 9, 10), 2, "jumped 1")],
)
def test_after_lost_frames_the_next_one_is_used_and_a_repeated_one_or_one_that_jumps_is_not(
    database: VehicleDatabase, mode: Mode, sent: tuple[int, ...], unused: int | None, counted: str
) -> None:
    found, counters = used(database, mode, battery(database, *sent))
    assert found == [number != unused for number in range(len(sent))]
    held_back = "held back 1, " if mode is Mode.GATEWAY and unused is not None else ""
    assert counters.text().endswith(f", {held_back}{counted}")


@pytest.mark.parametrize("mode", Mode)
def test_a_frame_with_a_wrong_crc_is_as_if_it_had_not_come(database: VehicleDatabase, mode: Mode) -> None:
    first, second, third = battery(database, 0, 1, 2)
    damaged = second[:2] + bytes([second[2] ^ 0x10]) + second[3:]
    found, counters = used(database, mode, [first, damaged, second, third, b""])
    assert found == [True, False, True, True, False]
    assert (counters.corrupt, counters.gaps, counters.repeated) == (2, 0, 0)
