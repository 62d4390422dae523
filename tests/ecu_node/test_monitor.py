"""``ecu-node monitor``: what it makes of frames (by cantools and autosar-e2e), and how it shows it."""

import errno
import json
import os
import pty
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Never

import can
import pytest
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.virtual import VirtualBus

from ecu_node.bus.wiring import key_of
from ecu_node.cli import main
from ecu_node.core.status import Counters, Quality, Reason, State
from ecu_node.database import VehicleDatabase
from ecu_node.monitor import BusMonitor, View, view_lines
from tests.ecu_node.vehicles import LAYOUT, SMALL_DBC, protected

CHANNEL = "monitor"
MONITOR = ["monitor", "--layout", str(LAYOUT), "--interface", "virtual", "--channel", CHANNEL]


class Bus:
    """Frames of the project's DBC, each message with its own counter."""

    def __init__(self, database: VehicleDatabase, start_s: float = 0.0) -> None:
        self.database, self.monitor = database, BusMonitor(database, start_s)
        self.counters: dict[str, int] = {}

    def send(self, message: str, time_s: float, *, step: int = 1, spoilt: bool = False, **values: Any) -> None:
        counter = self.counters[message] = (self.counters.get(message, -1) + step) % 15
        data = bytearray(protected(self.database, message, counter, **values))
        data[7] ^= spoilt
        self.monitor.take(key_of(self.database.message(message)), data, time_s)

    def send_pair(self, name: str, time_s: float, measured_a: float, corrected_a: float | None, quality: int) -> None:
        """A measured frame and its answer, in the direction of the signal."""
        measured: dict[str, Any] = {f"{name}Current": measured_a}
        self.send(f"HV_{name}", time_s, **measured)
        if corrected_a is not None:
            values: dict[str, Any] = {f"{name}CurrentCorrected": corrected_a, f"{name}CurrentQuality": quality}
            self.send(f"HV_{name}Corrected", time_s + 0.001, **values)

    def battery(self, time_s: float, measured_a: float, corrected_a: float | None = None, quality: int = 2) -> None:
        self.send_pair("Battery", time_s, measured_a, corrected_a, quality)

    def motor(self, time_s: float, measured_a: float, corrected_a: float | None = None) -> None:
        self.send_pair("Motor", time_s, measured_a, corrected_a, 2)

    def branch(self, now_s: float, name: str = "battery") -> View:
        return next(branch for branch in self.monitor.look(now_s)["branches"] if branch["name"] == name)

    def sums(self, now_s: float) -> tuple[float | None, float | None]:
        sums = self.monitor.look(now_s)["sums"]
        return sums["measured_a"], sums["corrected_a"]

    def lines(self, now_s: float, counters: Counters | None = None) -> list[str]:
        return view_lines(self.monitor.look(now_s), "can0", counters or Counters())


@pytest.fixture
def bus(database: VehicleDatabase) -> Bus:
    return Bus(database)


def currents(branch: View) -> tuple[Any, ...]:
    return branch["measured_a"], branch["corrected_a"], branch["correction_a"]


def test_branch_shows_measured_published_and_difference(bus: Bus) -> None:
    bus.battery(0.01, 100.0, 95.5)
    bus.motor(0.01, 80.0, 81.0)
    battery = bus.branch(0.05)
    assert currents(battery) == pytest.approx((100.0, 95.5, -4.5))
    assert currents(bus.branch(0.05, "motor")) == pytest.approx((-80.0, -81.0, -1.0))
    assert (battery["quality"], battery["age_s"]) == ("CORRECTED", pytest.approx(0.04))
    bus.battery(0.07, 200.0)
    assert currents(bus.branch(0.071)) == pytest.approx((100.0, 95.5, -4.5)), "until it is answered"
    for k in range(20):
        bus.battery(0.09 + 0.02 * k, 200.0)
    battery = bus.branch(0.55)
    assert (battery["measured_a"], battery["corrected_is_stale"]) == (pytest.approx(200.0), True)


def test_latency_is_from_a_frame_to_its_answer_on_the_bus(bus: Bus) -> None:
    assert bus.monitor.look(0.0)["latency_us"] is None
    for k in range(10):
        bus.battery(0.02 * k, 100.0, 95.0)
    assert bus.monitor.look(0.2)["latency_us"]["max"] == 1000
    assert "from a frame to its answer [us]: p50 1000, p99.9 1000, max 1000" in bus.lines(0.2)
    bus.battery(0.5, 100.0)
    bus.battery(3.0, 100.0, 95.0)
    assert bus.monitor.look(3.0)["latency_us"]["max"] == 1000, "a frame that nobody answered"


def test_sums_are_taken_in_one_instant_however_late_the_answers_come(bus: Bus) -> None:
    """Currents that rise by 1000 A/s with a sum of 5 A; the motor's frames are answered three at a time."""
    waiting: list[float] = []
    for k in range(30):
        t = 0.02 * k
        bus.battery(t, 1000.0 * t + 5.0)
        bus.motor(t + 0.003, 1000.0 * (t + 0.003))
        waiting.append(1000.0 * (t + 0.003))
        bus.send("HV_BatteryCorrected", t + 0.008, BatteryCurrentCorrected=1000.0 * t + 5.0, BatteryCurrentQuality=1)
        for motor_a in waiting if k % 3 == 2 else ():
            bus.send("HV_MotorCorrected", t + 0.012, MotorCurrentCorrected=motor_a, MotorCurrentQuality=1)
        waiting = waiting if k % 3 != 2 else []
        for look_s in (t + 0.001, t + 0.013):
            measured_a, corrected_a = bus.sums(look_s)
            if corrected_a is not None:
                assert (measured_a, corrected_a) == pytest.approx((5.0, 5.0), abs=0.03)
    assert corrected_a is not None


MIXED_DBC = """VERSION ""
BU_: Node Corrector
BO_ 1 Fast: 2 Node
 SG_ I : 0|16@1- (0.1,0) [-3000|3000] "A" Node
BO_ 2 Middle: 2 Node
 SG_ I : 0|16@1- (0.1,0) [-3000|3000] "A" Node
BO_ 4 Out: 4 Corrector
 SG_ Battery : 0|16@1- (0.1,0) [-3000|3000] "A" Node
 SG_ Motor : 16|16@1- (0.1,0) [-3000|3000] "A" Node
VAL_ 4 Battery -32768 "SNA";
VAL_ 4 Motor -32768 "SNA";
"""
MIXED_LAYOUT = """
schema = 1
name = "small"
dbc = "small.dbc"
full_scale_a = 400.0
branch = [
    { name = "battery", sign = 1, signal = "Fast.I", corrected = "Out.Battery" },
    { name = "motor", sign = -1, signal = "Middle.I", corrected = "Out.Motor" },
]
"""


def test_message_that_answers_several_counts_for_each_at_its_own_frames(
    make_database: Callable[..., VehicleDatabase],
) -> None:
    """At 100 and 50 Hz currents rise and sum to 0; every frame is answered by both, as they were last."""
    monitor = BusMonitor(make_database(MIXED_LAYOUT, dbc=MIXED_DBC), 0.0)
    latest, seen = {1: bytes(2), 2: bytes(2)}, 0
    for k in range(200):
        for identifier, late_s in ((1, 0.0), (2, 0.003)):
            t = 0.01 * k + late_s
            if k % identifier == 0:
                latest[identifier] = round(4000.0 * t).to_bytes(2, "little", signed=True)
                monitor.take((identifier, False), bytearray(latest[identifier]), t)
                monitor.take((4, False), bytearray(b"".join(latest.values())), t + 0.0005)
        sums = monitor.look(0.01 * k + 0.007)["sums"]
        if k > 50 and sums["corrected_a"] is not None:
            seen += 1
            assert (sums["measured_a"], sums["corrected_a"]) == pytest.approx((0.0, 0.0), abs=0.3)
    assert seen > 100


def test_sum_needs_a_fresh_value_of_every_branch_seen_and_its_answer(bus: Bus) -> None:
    bus.send("HV_BatteryCorrected", 0.001, BatteryCurrentCorrected=500.0)
    assert bus.sums(0.002) == (None, None)
    bus.battery(0.01, 100.0, 90.0)
    bus.motor(0.01, 80.0)
    assert bus.monitor.look(0.02)["sums"] == {"measured_a": pytest.approx(20.0), "corrected_a": None}
    assert [each["name"] for each in bus.monitor.look(0.02)["branches"] if each["is_seen"]] == ["battery", "motor"]
    bus.battery(0.3, 100.0, 90.0)
    assert bus.sums(0.31) == (None, None)
    assert bus.branch(0.31, "motor")["is_stale"]


def test_frames_that_fail_their_check_are_counted_and_not_used(bus: Bus) -> None:
    bus.send("HV_Battery", 0.01, BatteryCurrent=100.0)
    bus.send("HV_Battery", 0.02, step=0, BatteryCurrent=200.0)
    bus.send("HV_Battery", 0.03, spoilt=True, BatteryCurrent=300.0)
    bus.send("HV_Battery", 0.04, step=7, BatteryCurrent=400.0)
    bus.monitor.take((0x110, False), bytearray(), 0.05)
    bus.send("HV_BatteryCorrected", 0.05, spoilt=True)
    battery = bus.branch(0.06)
    assert battery["faults"] == {"corrupt": 2, "repeated": 1, "lost": 1}
    assert battery["corrected_faults"] == {"corrupt": 1, "repeated": 0, "lost": 0}
    assert (battery["measured_a"], battery["age_s"]) == pytest.approx((100.0, 0.05))
    (row,) = [line for line in bus.lines(0.06) if line.startswith("battery ")]
    assert row.endswith("corrupt 2, repeated 1, lost 1, corrected: corrupt 1")


def test_code_that_is_no_value_is_not_shown_as_a_current(bus: Bus) -> None:
    sna_a = -32768 * 0.02
    bus.battery(0.01, sna_a, sna_a, quality=Quality.NOT_AVAILABLE)
    assert currents(bus.branch(0.02)) == (None, None, None)
    assert " ".join(bus.lines(0.02)[3].split()) == "battery - - - not available 50.0 50.0 0.01 not available"


def test_power_is_shown_as_a_current(make_database: Callable[..., VehicleDatabase]) -> None:
    monitor = BusMonitor(make_database(dbc=SMALL_DBC), 0.0)
    monitor.take((258, False), bytearray((40000).to_bytes(2, "little")), 0.05)
    monitor.take((0x200, True), bytearray([*(4000).to_bytes(2, "little"), 0, 0]), 0.05)
    view = monitor.look(0.06)
    assert view["branches"][2]["measured_a"] == pytest.approx(-10.0)
    assert (view["has_status"], view["node"]) == (False, None)
    assert view_lines(view, "x", Counters())[0] == "x: the layout has no status message: nothing is known of a node"


@pytest.mark.parametrize("looks_hz", [4, 1])
def test_rates_are_those_of_the_last_seconds(bus: Bus, looks_hz: int) -> None:
    """50 frames/s for 5 s, then 100 frames/s for 5 s, corrupt ones included."""
    times = [0.02 * k for k in range(250)] + [5.0 + 0.01 * k for k in range(500)]
    rates = {}
    for look_s in [(k + 1) / looks_hz for k in range(10 * looks_hz)]:
        while times and times[0] < look_s:
            bus.send("HV_Battery", times.pop(0), spoilt=len(times) % 10 == 0)
        rates[look_s] = bus.branch(look_s)["rate_hz"]
    assert [rates[5.0], rates[6.0], rates[10.0]] == pytest.approx([50.0, 75.0, 100.0])


def status(bus: Bus, time_s: float, **values: Any) -> None:
    bus.send("HV_CorrectionStatus", time_s, **({"JunctionSumMeasured": -12.3, "JunctionSumCorrected": 0.4} | values))


def test_status_is_read_as_the_node_wrote_it(bus: Bus) -> None:
    bus.battery(1.2, 100.0, 95.0)
    status(bus, 1.0, State=State.PASSING_THROUGH, Reason=Reason.BRANCH_STALE, ParameterSet=44)
    node = bus.monitor.look(1.25)["node"]
    assert (node["state"], node["reason"], node["parameter_set"]) == ("PASSING_THROUGH", "BRANCH_STALE", 44)
    assert node["sums"] == {"measured_a": pytest.approx(-12.3), "corrected_a": pytest.approx(0.4)}
    assert (node["age_s"], node["is_silent"]) == (pytest.approx(0.25), False)
    lines = bus.lines(1.25)
    assert lines[0] == (
        f"can0: node: {State.PASSING_THROUGH.words}, because {Reason.BRANCH_STALE.words}; parameter set 44; status 0.2 "
        "s ago"
    )
    assert "node's sum, corrected: what its parameters would make of it; it publishes what was measured" in lines
    assert bus.lines(4.0)[0] == "can0: no node on this bus any more: its last status came 3.0 s ago"
    status(bus, 4.0, State=14, Reason=Reason.NONE, JunctionSumMeasured=-3276.8, JunctionSumCorrected=-3276.8)
    assert bus.monitor.look(4.0)["node"]["sums"] == {"measured_a": None, "corrected_a": None}
    assert bus.lines(4.0)[0] == "can0: node: state 14, which this version does not know; status 0.0 s ago"


@contextmanager
def battery_on_bus(database: VehicleDatabase) -> Iterator[can.BusABC]:
    """A battery that sends; the bus to listen on whether anybody else does."""
    ended = threading.Event()

    def send(bus: can.BusABC) -> None:
        counter = 0
        while not ended.wait(0.01):
            data = protected(database, "HV_Battery", counter % 15, BatteryCurrent=100.0)
            bus.send(can.Message(arbitration_id=0x110, is_extended_id=False, data=data))
            counter += 1

    with can.Bus(interface="virtual", channel=CHANNEL) as bus:
        thread = threading.Thread(target=send, args=(bus,))
        thread.start()
        try:
            yield bus
        finally:
            ended.set()
            thread.join()


@pytest.fixture
def handlers() -> Iterator[None]:
    """Leave signal handlers as they were."""
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
def test_once_prints_what_was_seen_and_sends_nothing(
    database: VehicleDatabase, capsys: pytest.CaptureFixture[str]
) -> None:
    with battery_on_bus(database) as bus:
        assert main([*MONITOR, "--listen-only", "--once", "0.5"]) == 0
        assert bus.recv(0.0) is None
        lines = capsys.readouterr().out.splitlines()
        assert main([*MONITOR, "--once", "0.3", "--json"]) == 0
    assert lines[0] == f"virtual {CHANNEL}: no node on this bus"
    assert next(line.split() for line in lines if line.startswith("battery"))[1] == "+100.00"
    assert lines[-1] == "no corrected messages on this bus: the currents are shown as they are on it"
    document = json.loads(capsys.readouterr().out)
    assert document["branches"][0]["measured_a"] == pytest.approx(100.0)
    assert document["is_bus_open"] is True


@pytest.mark.usefixtures("handlers")
def test_bus_without_any_branch_ends_in_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*MONITOR, "--once", "0.1"]) == 1
    captured = capsys.readouterr()
    line = f"ecu-node: virtual {CHANNEL}: no branch of {LAYOUT} was seen; see that the bus is the right one\n"
    assert captured.err == line
    assert captured.out.splitlines()[-1].startswith("no frame of any branch")


class FailingBus(VirtualBus):
    """A bus whose interface is down, as one of SocketCAN tells it."""

    def _recv_internal(self, timeout: float | None) -> Never:
        raise can.CanOperationError("Network is down", errno.ENETDOWN)


class SlowSocket(socket.socket):
    """A socket of which the kernel says that it has dropped three frames; a local one itself drops none."""

    def getsockopt(self, level: int, name: int, length: int = 4) -> bytes:  # type: ignore[override]
        return struct.pack("=9I", *8 * [0], 3) if name == 55 else super().getsockopt(level, name, length)


class FullBus(SocketcanBus):
    """A bus as of SocketCAN with an error frame and a remote frame."""

    def __init__(self) -> None:
        near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket, self.channel_info = SlowSocket(fileno=near.detach()), "a pair of sockets"
        self.far.send(struct.pack("=IB3x8s", 0x20000004, 8, bytes(8)))
        self.far.send(struct.pack("=IB3x8s", 0x40000110, 8, bytes(8)))

    def shutdown(self) -> None:
        self.socket.close()
        self.far.close()


@pytest.mark.usefixtures("handlers")
def test_what_is_wrong_with_its_own_interface_is_said(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ecu_node.monitor.open_bus", lambda *_, channel, **__: FailingBus(channel))
    assert main([*MONITOR, "--once", "0.2"]) == 1
    shown = capsys.readouterr().out
    assert shown.startswith(f"virtual {CHANNEL}: this computer's interface failed or is down; trying to open it again")
    assert "is the bus awake" not in shown
    monkeypatch.setattr("ecu_node.monitor.open_bus", lambda *_, **__: FullBus())
    assert main([*MONITOR, "--once", "0.2"]) == 1
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "error frames of the bus: 1; a wrong bit rate, or a fault in the wiring?",
        "frames that this computer was too slow to read: 3; they count as lost above",
    ]


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_without_a_terminal_a_block_comes_per_second_until_a_signal(
    how: signal.Signals, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if how is signal.SIGHUP:  # the terminal is gone, and with it standard output
        monkeypatch.setattr(sys, "stdout", None)
    timer = threading.Timer(1.3, os.kill, (os.getpid(), how))
    timer.start()
    start_s = time.monotonic()
    assert main(MONITOR) == 0
    timer.join()
    assert time.monotonic() - start_s < 10.0
    blocks = capsys.readouterr().out.strip().split("\n\n")
    assert how is signal.SIGHUP or len(blocks) == 2
    assert all(block.startswith(f"virtual {CHANNEL}: no node on this bus\n ") for block in blocks if block)


def test_in_a_terminal_a_table_is_drawn_and_ctrl_c_ends_it_with_0() -> None:
    ours, theirs = pty.openpty()
    shown, environment = b"", {**os.environ, "TERM": "xterm", "COLUMNS": "60", "LINES": "7"}
    command = [sys.executable, "-m", "ecu_node", *MONITOR]
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        while b"\x1b[J" not in shown:
            shown += os.read(ours, 65536)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
    os.close(ours)
    first = shown.decode().partition("\x1b[H")[2].partition("\x1b[J")[0].replace("\x1b[K", "").splitlines()
    assert first[0] == f"virtual {CHANNEL}: no node on this bus"
    assert len(first) == 6
    assert max(map(len, first)) <= 60
