"""The node on python-can's virtual bus: a real bus object, the node in a thread of its own."""

import errno
import operator
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
from ecu_node.bus.wiring import Mode, open_bus
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Counters, Reason
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError
from tests.ecu_node.processes import LONGEST_WAIT_S, wait_until
from tests.ecu_node.vehicles import SMALL_DBC, MakeDatabase, corrector_for, decoded, protected


@contextmanager
def node_on(
    database: VehicleDatabase, channel: str, opened: Callable[[], can.BusABC] | None = None, *, period_s: float = 0.02
) -> Iterator[Corrector]:
    corrector = corrector_for(database, Mode.OVERLAY, time.monotonic(), battery=(0.25, 5.0))
    bus = SteadyBus(opened or (lambda: overlay_bus(database, channel)), corrector.counters)
    with closing(bus), at_work(Node(bus, bus, corrector, period_s=period_s)):
        yield corrector


def overlay_bus(database: VehicleDatabase, channel: str) -> can.BusABC:
    return open_bus(database, interface="virtual", channel=channel, fd=False, mode=Mode.OVERLAY)


@contextmanager
def at_work(node: Node, *, may_end: bool = False) -> Iterator[Future[None]]:
    """Run a node in a thread; an error that ends it fails the test, unless it may end."""
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


def receive(
    bus: can.BusABC, identifier: int, count: int, is_wanted: Callable[[int, int], bool] = operator.eq
) -> list[can.Message]:
    """Return the first frames whose identifier is this one, or compares with it as `is_wanted` says."""
    found: list[can.Message] = []
    give_up = time.monotonic() + LONGEST_WAIT_S
    while len(found) < count:
        message = bus.recv(1.0)
        assert time.monotonic() < give_up, f"{len(found)} of {count} frames came"
        if message is not None and is_wanted(message.arbitration_id, identifier):
            found.append(message)
    return found


def battery_frame(database: VehicleDatabase, number: int, time_s: float = 0.0, current_a: float = 0.0) -> can.Message:
    """A frame of the battery with the counter of this number."""
    data = protected(database, "HV_Battery", number % 15, BatteryCurrent=current_a)
    return can.Message(time_s, arbitration_id=0x110, is_extended_id=False, data=data)


@pytest.fixture
def peer(channel: str) -> Iterator[can.BusABC]:
    """Bus object of the other control units."""
    with can.Bus(interface="virtual", channel=channel) as bus:
        yield bus


@pytest.mark.parametrize("filters", [True, False])
def test_node_answers_only_data_frames_of_branches(
    database: VehicleDatabase, peer: can.BusABC, channel: str, filters: bool
) -> None:
    with node_on(database, channel, None if filters else lambda: VirtualBus(channel)) as corrector:
        for k in range(100):
            frame = battery_frame(database, k, current_a=float(k))
            peer.send(frame)
            peer.send(can.Message(arbitration_id=0x111, is_extended_id=False, data=frame.data))
            peer.send(can.Message(arbitration_id=0x110, is_extended_id=True, data=frame.data))
            peer.send(can.Message(arbitration_id=0x110, is_extended_id=False, is_remote_frame=True, dlc=8))
            peer.send(can.Message(arbitration_id=0x110, is_error_frame=True, is_extended_id=False))
        answers = [decoded(database, "HV_BatteryCorrected", bytes(item.data)) for item in receive(peer, 0x510, 100)]
    currents = [values["BatteryCurrentCorrected"] for values in answers]
    assert currents == pytest.approx([(k - 5.0) / 1.25 for k in range(100)], abs=0.0101)
    assert (corrector.counters.frames_in, corrector.counters.answers) == (100, 100)


def test_second_node_on_the_bus_refuses_to_start(database: VehicleDatabase, peer: can.BusABC, channel: str) -> None:
    with node_on(database, channel, period_s=0.2):
        receive(peer, 0x5F0, 2)
        with pytest.raises(BusError, match="0x5F0"), node_on(database, channel, period_s=0.2):
            receive(peer, 0x5F0, 3)
        receive(peer, 0x5F0, 1)


def test_node_stops_if_another_node_sends_its_frames(database: VehicleDatabase, peer: can.BusABC, channel: str) -> None:
    with pytest.raises(BusError, match="another node sends frames 0x510"), node_on(database, channel):  # noqa: PT012
        receive(peer, 0x5F0, 1)
        peer.send(can.Message(arbitration_id=0x510, is_extended_id=False, data=bytes(8)))
        while peer.recv(0.2) is not None:
            pass


Hook = Callable[..., object]


def undisturbed(*_: object) -> None:
    """Nothing happens."""


class Adapter(VirtualBus):
    """A bus that calls a hook before it sends, and one before it receives; a hook may raise an error, or wait."""

    def __init__(self, channel: str, *, sending: Hook = undisturbed, receiving: Hook = undisturbed) -> None:
        super().__init__(channel)
        self.sending, self.receiving = sending, receiving

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.sending(msg)
        super().send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self.receiving()
        return super()._recv_internal(timeout)


def failing(error: Exception) -> Hook:
    def fail(*_: object) -> None:
        raise error

    return fail


def test_echo_of_own_frames_is_counted_and_ignored(database: VehicleDatabase, peer: can.BusABC, channel: str) -> None:
    """Some adapters return what is sent through them."""
    bus = Adapter(channel, sending=lambda message: bus.queue.put(deepcopy(message)))
    with node_on(database, "", lambda: bus) as corrector:
        receive(peer, 0x5F0, 1)
        peer.send(battery_frame(database, 0))
        receive(peer, 0x510, 1)
        receive(peer, 0x5F0, 5)
    assert corrector.counters.echoes >= 5
    assert (corrector.counters.frames_in, corrector.counters.answers) == (1, 1)


def test_full_send_queue_is_logged_once_and_shown_as_state(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    said, states = list[str](), list[str]()
    full = Adapter(channel, sending=failing(can.CanOperationError("Transmit buffer full")))
    now_s, frame = time.monotonic(), can.Message(arbitration_id=1)
    with closing(SteadyBus(lambda: full, Counters(), said.append)) as bus:
        for later_s in (0.0, 0.5, 1.5, 12.0):
            monkeypatch.setattr(time, "monotonic", lambda later_s=later_s: now_s + later_s)
            bus.send(frame)
            assert bus.flush() == (0, 1)
            states.append(bus.state)
        full.sending = undisturbed
        bus.send(frame)
        assert bus.flush() == (1, 0)
        states.append(bus.state)
    assert [*states, bus.state] == ["open", "open", "full", "full", "open", "gone"]
    first, second = said
    assert "the send queue stays full" in first
    assert "takes frames again" in second


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
            super().recv(min(timeout or 0.0, 0.005))
        if time.time() < due_s:  # else it came during the wait, however long that was on a busy machine
            return None
        round_, which = divmod(self._sent, 3)
        self._sent += 1
        name = ("HV_Battery", "HV_Motor", "HV_Auxiliary")[which]
        identifier = self._database.message(name).frame_id
        data = protected(self._database, name, round_ % 15)
        return can.Message(due_s, identifier, is_extended_id=False, data=data)


def test_pause_of_the_process_makes_no_branch_stale(database: VehicleDatabase, channel: str) -> None:
    bus = DrivingBus(channel, database)
    with node_on(database, "", lambda: bus) as corrector:
        wait_until(lambda: corrector.counters.frames_in > 20)
        bus.pause_s = 0.13
        before = corrector.counters.frames_in
        wait_until(lambda: corrector.counters.frames_in > before + 60)
        assert corrector.latched is Reason.NONE
    assert corrector.counters.clock_steps == 0


def test_pause_of_the_process_is_not_time_of_listening(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    silent, now_s = VirtualBus(channel), time.monotonic()
    with closing(SteadyBus(lambda: silent, Counters())) as bus:
        clock = iter([now_s, now_s + 5.0])
        monkeypatch.setattr(silent, "recv", lambda _: None)
        monkeypatch.setattr("ecu_node.bus.steady_bus.time.monotonic", lambda: next(clock))
        assert bus.receive(0.1) is None
        monkeypatch.undo()
    assert bus.asked_s == pytest.approx(now_s + 0.1)


def test_frames_that_waited_too_long_are_not_used(database: VehicleDatabase, channel: str) -> None:
    with node_on(database, channel) as corrector:
        for counter, age_s in enumerate((0.0, 0.5, 0.0)):
            with VirtualBus(channel, preserve_timestamps=True) as bus:
                bus.send(battery_frame(database, counter, time.time() - age_s))
        wait_until(lambda: corrector.counters.frames_in + corrector.counters.late == 3)
    assert (corrector.counters.answers, corrector.counters.late) == (2, 1)


def test_failed_bus_is_logged_as_open_only_when_it_works_again(peer: can.BusABC, channel: str) -> None:
    """An error frame that reports bus-off just as the bus opens again is counted."""
    down = can.CanOperationError("Network is down", errno.ENETDOWN)
    opened = iter([*(Adapter(f"{channel} down", receiving=failing(down)) for _ in range(3)), VirtualBus(channel)])
    peer.send(can.Message(arbitration_id=0x40, is_error_frame=True))
    said, counters = list[str](), Counters()
    with closing(SteadyBus(lambda: next(opened), counters, said.append)) as bus:
        wait_until(lambda: bus.receive(0.01) is None and counters.reopened == 1)
    assert list(opened) == []
    assert [line.partition(": ")[2].partition(":")[0] for line in said] == ["the bus failed", "the bus is open again"]
    assert (counters.bus_errors, counters.bus_off) == (1, 1)


def test_frame_that_the_bus_rejects_does_not_block_later_frames(peer: can.BusABC, channel: str) -> None:
    def take_classic(message: can.Message) -> None:
        if message.is_fd:
            raise can.CanOperationError("Invalid argument", errno.EINVAL)

    with closing(SteadyBus(lambda: Adapter(channel, sending=take_classic), Counters())) as bus:
        for identifier, is_fd in ((1, False), (2, True), (3, False)):
            bus.send(can.Message(arbitration_id=identifier, is_fd=is_fd))
        assert bus.flush() == (2, 1)
    assert [receive(peer, identifier, 1)[0].arbitration_id for identifier in (1, 3)] == [1, 3]


def test_bus_whose_sending_fails_is_opened_again(database: VehicleDatabase, peer: can.BusABC, channel: str) -> None:
    """The kernel reports the error only once."""
    gone = can.CanOperationError("No such device or address", errno.ENXIO)
    buses = iter([Adapter(channel, sending=failing(gone)), overlay_bus(database, channel)])
    with node_on(database, "", lambda: next(buses)) as corrector:
        receive(peer, 0x5F0, 3)
    assert corrector.counters.reopened == 1


def test_kernel_filter_passes_only_ids_of_branches_voltages_and_own_messages(make_database: MakeDatabase) -> None:
    with overlay_bus(make_database(), "filters") as bus:
        filters = bus.filters or []
    found = {(item["can_id"], item["can_mask"], item["extended"]) for item in filters}
    assert found == {(512, 0x1FFFFFFF, True), *((number, 0x7FF, False) for number in (256, 258, 512))}


def test_bus_for_a_dbc_with_fd_messages_opens_only_with_option_fd(make_database: MakeDatabase) -> None:
    database = make_database(dbc=SMALL_DBC.replace("PairOut: 8", "PairOut: 16"))
    with pytest.raises(BusError, match=r"CAN FD messages \(PairOut\); start with --fd"):
        open_bus(database, interface="virtual", channel="c0", fd=False, mode=Mode.OVERLAY)
    with open_bus(database, interface="virtual", channel="c0", fd=True, mode=Mode.OVERLAY):
        pass
