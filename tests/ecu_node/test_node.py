"""The node on python-can's virtual bus: a real bus object, the node in a thread of its own."""

import errno
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from copy import deepcopy

import can
import pytest
from can.interfaces.virtual import VirtualBus

from ecu_node.bus.node import Node
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.wiring import InForce, Mode, open_bus, receive_filters, wire
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Counters, Reason, State
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError
from tests.ecu_node.vehicles import SMALL_DBC, MakeDatabase, decoded, parameters_for, protected

LONGEST_WAIT_S = 20.0


@contextmanager
def node_on(
    database: VehicleDatabase, channel: str, opened: Callable[[], can.BusABC] | None = None, *, period_s: float = 0.02
) -> Iterator[Corrector]:
    corrector = wire(database, InForce(parameters=parameters_for(database, battery=(0.25, 5.0))), time.monotonic())
    bus = SteadyBus(opened or (lambda: overlay_bus(database, channel)), corrector.counters)
    with closing(bus), at_work(Node(bus, bus, corrector, period_s=period_s)):
        yield corrector


def overlay_bus(database: VehicleDatabase, channel: str) -> can.BusABC:
    return open_bus(database, interface="virtual", channel=channel, fd=False, mode=Mode.OVERLAY)


@contextmanager
def at_work(node: Node, *, may_end: bool = False) -> Iterator[Future[None]]:
    """Run a node in a thread; what ends it, ends the test, unless it may end."""
    stop, ready = threading.Event(), threading.Event()
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(node.run, stop.is_set, ready.set)
        while not ready.wait(0.01) and not running.done():
            pass
        try:
            yield running
        finally:
            stop.set()
            running.exception(LONGEST_WAIT_S)
    if not may_end:
        running.result()


def receive(bus: can.BusABC, identifier: int, count: int) -> list[can.Message]:
    """The first frames of one identifier."""
    found: list[can.Message] = []
    give_up = time.monotonic() + LONGEST_WAIT_S
    while len(found) < count:
        message = bus.recv(1.0)
        assert time.monotonic() < give_up, f"{len(found)} of {count} frames came"
        if message is not None and message.arbitration_id == identifier:
            found.append(message)
    return found


@pytest.fixture
def peer(channel: str) -> Iterator[can.BusABC]:
    """The rest of the vehicle."""
    with can.Bus(interface="virtual", channel=channel) as bus:
        yield bus


def test_frames_are_corrected_on_the_bus_and_others_left_alone(
    database: VehicleDatabase, peer: can.BusABC, channel: str
) -> None:
    with node_on(database, channel) as corrector:
        for k in range(100):
            data = protected(database, "HV_Battery", k % 15, BatteryCurrent=float(k))
            peer.send(can.Message(arbitration_id=0x110, is_extended_id=False, data=data))
            peer.send(can.Message(arbitration_id=0x111, is_extended_id=False, data=data))
            peer.send(can.Message(arbitration_id=0x110, is_extended_id=True, data=data))
            peer.send(can.Message(arbitration_id=0x110, is_extended_id=False, is_remote_frame=True, dlc=8))
            peer.send(can.Message(arbitration_id=0x110, is_error_frame=True, is_extended_id=False))
        answers = receive(peer, 0x510, 100)
    currents = [
        decoded(database, "HV_BatteryCorrected", bytes(item.data))["BatteryCurrentCorrected"] for item in answers
    ]
    assert currents == pytest.approx([(k - 5.0) / 1.25 for k in range(100)], abs=0.0101)
    assert (corrector.counters.frames_in, corrector.counters.answers) == (100, 100)


def test_a_node_listens_as_long_as_another_one_may_be_silent(
    database: VehicleDatabase, peer: can.BusABC, channel: str
) -> None:
    with node_on(database, channel, period_s=0.5):
        receive(peer, 0x5F0, 2)
        with pytest.raises(BusError, match="0x5F0"), node_on(database, channel, period_s=0.5):
            receive(peer, 0x5F0, 3)
        receive(peer, 0x5F0, 1)


class EchoingBus(VirtualBus):
    """A bus that returns what is sent, as some adapters do."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        super().send(msg, timeout)
        self.queue.put(deepcopy(msg))


def test_own_frames_that_come_back_are_counted_and_nothing_more(
    database: VehicleDatabase, peer: can.BusABC, channel: str
) -> None:
    with node_on(database, "", lambda: EchoingBus(channel)) as corrector:
        receive(peer, 0x5F0, 1)
        peer.send(can.Message(arbitration_id=0x110, is_extended_id=False, data=protected(database, "HV_Battery", 0)))
        receive(peer, 0x510, 1)
        receive(peer, 0x5F0, 5)
    assert corrector.counters.echoes >= 5
    assert (corrector.counters.frames_in, corrector.counters.answers) == (1, 1)


class DefectBus(VirtualBus):
    """A bus with an adapter whose software is defect as soon as the node is at work."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise RuntimeError("defect")


def test_a_gateway_of_which_one_direction_fails_ends(database: VehicleDatabase, channel: str) -> None:
    in_force = InForce(parameters=parameters_for(database, battery=(0.25, 5.0)))
    corrector = wire(database, in_force, time.monotonic(), mode=Mode.GATEWAY)
    near = SteadyBus(lambda: DefectBus(channel), corrector.counters)
    far = SteadyBus(lambda: VirtualBus(f"{channel} vehicle"), corrector.counters)
    with (  # noqa: PT012
        can.Bus(interface="virtual", channel=f"{channel} vehicle") as vehicle,
        closing(near),
        closing(far),
        pytest.raises(RuntimeError, match="defect"),
        at_work(Node(near, far, corrector, period_s=0.02)),
    ):
        receive(vehicle, 0x5F0, 1)
        vehicle.send(can.Message(arbitration_id=0x222, is_extended_id=False))
        while vehicle.recv(1.0) is not None:
            pass


class FullBus(VirtualBus):
    """A bus whose queue is full."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("Transmit buffer full")


class BrokenBus(VirtualBus):
    """A bus that is gone as soon as one listens."""

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        raise can.CanOperationError("Network is down", errno.ENETDOWN)


def test_a_send_queue_that_stays_full_is_told_and_when_it_opens_again(
    database: VehicleDatabase, channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = list[str]()
    full = FullBus(channel)
    bus = SteadyBus(lambda: full, Counters(), said.append)
    frame = can.Message(arbitration_id=1)
    now_s = time.monotonic()
    states = []
    for later_s in (0.0, 0.5, 1.5, 12.0):
        monkeypatch.setattr(time, "monotonic", lambda later_s=later_s: now_s + later_s)
        bus.send(frame)
        assert bus.flush() == (0, 1)
        states.append(bus.state)
    assert len(said) == 1
    assert "the send queue stays full" in said[0]
    monkeypatch.setattr(full, "send", lambda *_: None)
    bus.send(frame)
    assert bus.flush() == (1, 0)
    assert "takes frames again" in said[1]
    states.append(bus.state)
    bus.close()
    assert [*states, bus.state] == ["open", "open", "full", "full", "open", "gone"]


class DrivingBus(VirtualBus):
    """A bus on which three branches send in turn, one frame each 5 ms; reading may pause, then frames wait to be read.

    Two of the branches have a timeout of 0.1 s, one of 0.25 s.
    """

    pause_s = 0.0

    def __init__(self, channel: str, database: VehicleDatabase) -> None:
        super().__init__(channel)
        self._database, self._sent, self._start_s = database, 0, time.time()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        pause_s, self.pause_s = self.pause_s, 0.0
        time.sleep(pause_s)
        due_s = self._start_s + 0.005 * self._sent
        if time.time() < due_s:
            return super().recv(min(timeout or 0.0, 0.005))
        round_, which = divmod(self._sent, 3)
        self._sent += 1
        name = ("HV_Battery", "HV_Motor", "HV_Auxiliary")[which]
        identifier = self._database.message(name).frame_id
        data = protected(self._database, name, round_ % 15)
        return can.Message(due_s, identifier, is_extended_id=False, data=data)


def test_a_pause_of_the_process_makes_no_branch_stale(database: VehicleDatabase, channel: str) -> None:
    bus = DrivingBus(channel, database)
    with node_on(database, "", lambda: bus) as corrector:
        wait_until(lambda: corrector.counters.frames_in > 20)
        bus.pause_s = 0.13
        before = corrector.counters.frames_in
        wait_until(lambda: corrector.counters.frames_in > before + 60)
        assert corrector.latched is Reason.NONE
    assert corrector.counters.clock_steps == 0


def test_frames_that_waited_too_long_are_not_used(database: VehicleDatabase, channel: str) -> None:
    with node_on(database, channel) as corrector:
        for counter, age_s in enumerate((0.0, 0.5, 0.0)):
            data = protected(database, "HV_Battery", counter)
            with VirtualBus(channel, preserve_timestamps=True) as bus:
                bus.send(can.Message(time.time() - age_s, arbitration_id=0x110, is_extended_id=False, data=data))
        wait_until(lambda: corrector.counters.frames_in + corrector.counters.late == 3)
    assert (corrector.counters.answers, corrector.counters.late) == (2, 1)


class SetClockBus(VirtualBus):
    """A bus during whose waits the system's time is set back by half a second each time; then a frame comes."""

    clock: "SetClock"
    frames: list[bytes]

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if not self.frames or not timeout:
            return super().recv(timeout)
        self.clock.ahead_s -= 0.5
        return can.Message(self.clock.time(), 0x110, is_extended_id=False, data=self.frames.pop(0))


class SetClock:
    """The module ``time`` with a time of day that can be set."""

    monotonic, sleep = staticmethod(time.monotonic), staticmethod(time.sleep)
    ahead_s = 0.0

    def time(self) -> float:
        return time.time() + self.ahead_s


def test_a_frame_that_comes_after_the_clock_was_set_is_not_taken_for_an_old_one(
    database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch, channel: str
) -> None:
    bus = SetClockBus(channel)
    bus.clock, bus.frames = SetClock(), []
    monkeypatch.setattr("ecu_node.bus.node.time", bus.clock)
    with node_on(database, "", lambda: bus) as corrector:
        wait_until(lambda: corrector.state()[0] is State.STARTING)
        bus.frames = [protected(database, "HV_Battery", k) for k in range(8)]
        wait_until(lambda: corrector.counters.frames_in == 8)
        age_s = time.monotonic() - corrector.branches[0].time_s
    assert age_s < 0.4
    assert corrector.counters.clock_steps >= 8


def wait_until(done: Callable[[], bool]) -> None:
    give_up = time.monotonic() + LONGEST_WAIT_S
    while not done():
        assert time.monotonic() < give_up, "waited in vain"
        time.sleep(0.002)


def test_a_bus_that_can_be_opened_but_is_down_is_not_said_to_be_open(
    database: VehicleDatabase, peer: can.BusABC, channel: str
) -> None:
    opened = 0
    said: list[str] = []

    def reopen() -> can.BusABC:
        nonlocal opened
        opened += 1
        return BrokenBus(channel) if opened < 4 else overlay_bus(database, channel)

    counters = Counters()
    bus = SteadyBus(reopen, counters, said.append)
    give_up = time.monotonic() + LONGEST_WAIT_S
    while counters.reopened == 0:
        assert bus.receive(0.01) is None
        assert time.monotonic() < give_up
    bus.close()
    assert (opened, counters.reopened) == (4, 1)
    assert [line.partition(": ")[2].partition(":")[0] for line in said] == ["the bus failed", "the bus is open again"]


class GoneForSendersBus(VirtualBus):
    """A bus that is gone, and says so only to who sends: the kernel tells it once."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("No such device or address", errno.ENXIO)


def test_a_bus_of_which_only_sending_tells_that_it_is_gone_is_opened_again(
    database: VehicleDatabase, peer: can.BusABC, channel: str
) -> None:
    buses = iter([GoneForSendersBus(channel), overlay_bus(database, channel)])
    with node_on(database, "", lambda: next(buses)) as corrector:
        receive(peer, 0x5F0, 3)
    assert corrector.counters.reopened == 1


def test_the_kernel_is_asked_for_branches_voltages_and_own_frames_only(make_database: MakeDatabase) -> None:
    filters = receive_filters(make_database(), Mode.OVERLAY)
    assert {(item["can_id"], item["can_mask"], item["extended"]) for item in filters} == {
        (256, 0x7FF, False),
        (512, 0x1FFFFFFF, True),
        (258, 0x7FF, False),
        (512, 0x7FF, False),
    }


def test_a_can_fd_database_needs_fd(make_database: MakeDatabase) -> None:
    database = make_database(dbc=SMALL_DBC.replace("PairOut: 8", "PairOut: 16"))
    with pytest.raises(BusError, match=r"CAN FD messages \(PairOut\); start with --fd"):
        open_bus(database, interface="virtual", channel="c0", fd=False, mode=Mode.OVERLAY)
    with open_bus(database, interface="virtual", channel="c0", fd=True, mode=Mode.OVERLAY):
        pass
