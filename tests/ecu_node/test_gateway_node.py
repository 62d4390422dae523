"""A gateway on two of python-can's virtual buses: real bus objects, the node in threads of its own."""

import operator
import random
import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import partial
from itertools import takewhile
from typing import Any

import can
import pytest
from can.interfaces.virtual import VirtualBus

from ecu_node.bus.node import Node
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.wiring import Mode
from ecu_node.core.corrector import Corrector
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError
from tests.ecu_node.processes import LONGEST_WAIT_S, wait_until
from tests.ecu_node.test_node import Adapter, Hook, at_work, battery_frame, failing, receive, undisturbed
from tests.ecu_node.test_socketcan import is_same, random_frame
from tests.ecu_node.vehicles import corrector_for, decoded

Ends = tuple[can.BusABC, can.BusABC]


@pytest.fixture
def ends(channel: str) -> Iterator[Ends]:
    """The sensors' and the vehicle's bus: bus objects of the other control units."""
    with VirtualBus(f"{channel} a") as sensors, VirtualBus(f"{channel} b") as rest:
        yield sensors, rest


@contextmanager
def gateway(
    database: VehicleDatabase, name: str, other: str = "b", sending: Hook = undisturbed, **options: Any
) -> Iterator[tuple[Corrector, Future[None]]]:
    """A gateway between the two buses, with a fault of the battery's sensor in force."""
    corrector = corrector_for(database, Mode.GATEWAY, time.monotonic(), battery=(0.25, 5.0))
    near = SteadyBus(lambda: Adapter(f"{name} a", sending=sending), corrector.counters)
    far = SteadyBus(lambda: VirtualBus(f"{name} {other}"), corrector.counters)
    node = Node(near, far, corrector, period_s=0.02, **options)
    with closing(near), closing(far), at_work(node, may_end=True) as running:
        yield corrector, running


STATUS = 0x5F0


def received(bus: can.BusABC, count: int) -> list[can.Message]:
    """The next frames other than status messages."""
    return receive(bus, STATUS, count, operator.ne)


def test_gateway_keeps_order_and_changes_only_branches(database: VehicleDatabase, ends: Ends, channel: str) -> None:
    sensors, vehicle = ends
    chance = random.Random(1)
    sent = [random_frame(chance) for _ in range(1000)]
    sent = [frame for frame in sent if frame.is_extended_id or not 0x100 <= frame.arbitration_id < 0x600]
    sent[::3] = [battery_frame(database, number, current_a=100.0) for number in range(len(sent[::3]))]
    with gateway(database, channel) as (corrector, _):
        for message in sent:
            sensors.send(message)
        found = received(vehicle, len(sent))
        assert corrector.counters.forwarded == len(sent)
    for before, after in zip(sent, found, strict=True):
        if before.arbitration_id == 0x110:
            assert decoded(database, "HV_Battery", bytes(after.data))["BatteryCurrent"] == pytest.approx(76.0)
        else:
            assert is_same(after, before)
    assert sensors.recv(0.0) is None, "nothing comes back"


def test_watchdog_is_not_fed_while_a_send_to_the_sensor_bus_is_stuck(
    database: VehicleDatabase, ends: Ends, monkeypatch: pytest.MonkeyPatch, channel: str
) -> None:
    monkeypatch.setattr("ecu_node.bus.node._LONGEST_TURN_S", 0.2)
    let_go, works = threading.Event(), deque[bool](maxlen=20)
    hooks: Any = {"sending": lambda _: let_go.wait(LONGEST_WAIT_S), "on_tick": lambda _, fed: works.append(fed)}
    with gateway(database, channel, **hooks):
        try:
            wait_until(lambda: True in works)
            ends[1].send(can.Message(arbitration_id=0x300))
            wait_until(lambda: True not in works)
        finally:
            let_go.set()
        wait_until(lambda: True in works)


def test_frames_from_before_the_start_are_not_passed_on(database: VehicleDatabase, ends: Ends, channel: str) -> None:
    ended = threading.Event()

    def send_early() -> None:
        while not ended.wait(0.002):
            for bus in ends:
                bus.send(can.Message(arbitration_id=0x300, is_extended_id=False, data=[1]))

    with ThreadPoolExecutor(1) as pool:
        sending = pool.submit(send_early)
        with gateway(database, channel):
            ended.set()
            sending.result(LONGEST_WAIT_S)
            for bus in ends:
                bus.send(can.Message(arbitration_id=0x301, is_extended_id=False, data=[2]))
            for bus in ends:
                early = 0
                while received(bus, 1)[0].arbitration_id != 0x301:
                    early += 1
                assert early < 10, "those of the listening, more than 10, are not passed on"


def test_remote_frames_pass_from_vehicle_to_sensors(database: VehicleDatabase, ends: Ends, channel: str) -> None:
    sensors, vehicle = ends
    remote = partial(can.Message, is_extended_id=False, is_remote_frame=True, dlc=8)
    asked = [remote(arbitration_id=key) for key in (0x110, 0x5F0)]
    with gateway(database, channel) as (corrector, _):
        for message in asked:
            vehicle.send(message)
        assert list(map(is_same, receive(sensors, 0, 2, operator.ge), asked)) == [True, True]
        wait_until(lambda: corrector.counters.returned == 2)


def test_gateway_stops_if_one_direction_fails(database: VehicleDatabase, ends: Ends, channel: str) -> None:
    with gateway(database, channel, sending=failing(RuntimeError("defect"))) as (_, running):
        ends[1].send(can.Message(arbitration_id=0x222, is_extended_id=False))
        with pytest.raises(RuntimeError, match="defect"):
            running.result(LONGEST_WAIT_S)


WORDS = "another node sends frames 0x(110|5F0), which only this one may send there; two nodes on one bus, or two buses"


@pytest.mark.parametrize(("origin", "identifier"), [("vehicle", 0x110), ("vehicle", 0x5F0), ("sensors", 0x5F0)])
def test_frames_that_only_the_gateway_may_send_are_dropped_and_counted_if_foreign(
    database: VehicleDatabase, ends: Ends, channel: str, origin: str, identifier: int
) -> None:
    sensors, vehicle = ends
    with gateway(database, channel) as (corrector, running):
        receive(vehicle, STATUS, 1)
        sender = vehicle if origin == "vehicle" else sensors
        for counter in range(100):
            sender.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=[counter, *bytes(7)]))
        for counter in range(10):
            sensors.send(battery_frame(database, counter))
        found = received(vehicle, 10)
        wait_until(lambda: corrector.counters.foreign == 100)
        assert not running.done()
    assert {message.arbitration_id for message in found} == {0x110}
    assert sensors.recv(0.0) is None, "none was passed on"


def test_gateway_with_both_ends_on_one_bus_stops(database: VehicleDatabase, ends: Ends, channel: str) -> None:
    sensors, _ = ends
    with gateway(database, channel, "a") as (_, running):
        for counter in takewhile(lambda _: not running.done(), range(100)):
            sensors.send(battery_frame(database, counter))
            time.sleep(0.005)
        with pytest.raises(BusError, match=WORDS):
            running.result(LONGEST_WAIT_S)


def test_second_gateway_between_two_buses_refuses_to_start(database: VehicleDatabase, ends: Ends, channel: str) -> None:
    _, vehicle = ends
    with gateway(database, channel) as (_, first):
        receive(vehicle, STATUS, 1)
        with gateway(database, channel) as (_, second), pytest.raises(BusError, match=WORDS):
            second.result(LONGEST_WAIT_S)
        receive(vehicle, STATUS, 3)
        assert not first.done()


def test_branch_frame_that_waited_too_long_is_dropped(database: VehicleDatabase, ends: Ends, channel: str) -> None:
    with gateway(database, channel) as (corrector, _), VirtualBus(f"{channel} a", preserve_timestamps=True) as bus:
        for counter, age_s in enumerate((0.0, 5.0, 0.0)):
            bus.send(battery_frame(database, counter, time.time() - age_s))
        frames = [decoded(database, "HV_Battery", bytes(frame.data)) for frame in received(ends[1], 2)]
        assert ([frame["AliveCounter"] for frame in frames], corrector.counters.late) == ([0, 2], 1)
