"""``ecu-node monitor``: how it evaluates and shows frames, which are made with cantools and autosar-e2e."""

import json
import os
import pty
import signal
import subprocess
import sys
from itertools import cycle
from typing import Any

import can
import pytest

from ecu_node.bus.wiring import key_of
from ecu_node.core.status import Counters, Quality, Reason, State
from ecu_node.database import VehicleDatabase
from ecu_node.monitor import BusMonitor, View, view_lines
from tests.ecu_node.processes import ecu_node
from tests.ecu_node.vehicles import LAYOUT, MakeDatabase, protected

CHANNEL = "monitor"
MONITOR = ["monitor", "--layout", str(LAYOUT), "--interface", "virtual", "--channel", CHANNEL]


class Bus:
    """Sends frames of the project's DBC to a monitor; each message has its own counter."""

    def __init__(self, database: VehicleDatabase, start_s: float = 0.0) -> None:
        self.database, self.monitor = database, BusMonitor(database, start_s)
        self.counters: dict[str, int] = {}

    def send(self, message: str, time_s: float, *, step: int = 1, spoilt: bool = False, **values: Any) -> None:
        counter = self.counters[message] = (self.counters.get(message, -1) + step) % 15
        data = bytearray(protected(self.database, message, counter, **values))
        data[7] ^= spoilt
        self.monitor.take(key_of(self.database.message(message)), data, time_s)

    def pair(self, name: str, time_s: float, measured_a: float, corrected_a: float | None = None) -> None:
        """Send a measured frame and, if a corrected current is given, its answer; signs are those of the signals."""
        values: dict[str, Any] = {f"{name}Current": measured_a}
        self.send(f"HV_{name}", time_s, **values)
        if corrected_a is not None:
            values = {f"{name}CurrentCorrected": corrected_a, f"{name}CurrentQuality": 2}
            self.send(f"HV_{name}Corrected", time_s + 0.001, **values)

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


def currents(branch: View) -> list[Any]:
    return [branch[key] for key in ("measured_a", "corrected_a", "correction_a")]


def test_monitor_shows_measured_and_published_currents_and_their_difference(bus: Bus) -> None:
    bus.pair("Battery", 0.01, 100.0, 95.5)
    bus.pair("Motor", 0.01, 80.0, 81.0)
    battery = bus.branch(0.05)
    assert currents(battery) == pytest.approx([100.0, 95.5, -4.5])
    assert currents(bus.branch(0.05, "motor")) == pytest.approx([-80.0, -81.0, -1.0])
    assert (battery["quality"], battery["age_s"]) == ("CORRECTED", pytest.approx(0.04))
    bus.pair("Battery", 0.07, 200.0)
    assert currents(bus.branch(0.071)) == pytest.approx([100.0, 95.5, -4.5]), "until it is answered"
    for k in range(20):
        bus.pair("Battery", 0.09 + 0.02 * k, 200.0)
    battery = bus.branch(0.55)
    assert (battery["measured_a"], battery["corrected_is_stale"]) == (pytest.approx(200.0), True)


def test_latency_is_measured_from_a_frame_to_its_answer_on_the_bus(bus: Bus) -> None:
    assert bus.monitor.look(0.0)["latency_us"] is None
    for k in range(10):
        bus.pair("Battery", 0.02 * k, 100.0, 95.0)
    assert bus.monitor.look(0.2)["latency_us"]["max"] == 1000
    assert "from a frame to its answer [us]: p50 1000, p99.9 1000, max 1000" in bus.lines(0.2)
    bus.pair("Battery", 0.5, 100.0)
    bus.pair("Battery", 3.0, 100.0, 95.0)
    assert bus.monitor.look(3.0)["latency_us"]["max"] == 1000, "a frame that nobody answered"


def test_sums_are_taken_at_one_instant_however_late_the_answers_are(bus: Bus) -> None:
    """Currents that rise by 1000 A/s with a sum of 5 A; the motor's frames are answered three at a time."""
    waiting: list[float] = []
    for k in range(30):
        t = 0.02 * k
        bus.pair("Battery", t, 1000.0 * t + 5.0)
        bus.pair("Motor", t + 0.003, 1000.0 * (t + 0.003))
        waiting.append(1000.0 * (t + 0.003))
        bus.send("HV_BatteryCorrected", t + 0.008, BatteryCurrentCorrected=1000.0 * t + 5.0, BatteryCurrentQuality=1)
        while k % 3 == 2 and waiting:
            bus.send("HV_MotorCorrected", t + 0.012, MotorCurrentCorrected=waiting.pop(0), MotorCurrentQuality=1)
        for look_s in (t + 0.001, t + 0.013):
            measured_a, corrected_a = bus.sums(look_s)
            if corrected_a is not None:
                assert (measured_a, corrected_a) == pytest.approx((5.0, 5.0), abs=0.03)
    assert corrected_a is not None


def test_measured_sum_needs_all_seen_branches_fresh_and_corrected_sum_also_their_answers(bus: Bus) -> None:
    bus.send("HV_BatteryCorrected", 0.001, BatteryCurrentCorrected=500.0)
    assert bus.sums(0.002) == (None, None)
    bus.pair("Battery", 0.01, 100.0, 90.0)
    bus.pair("Motor", 0.01, 80.0)
    measured_a, corrected_a = bus.sums(0.02)
    assert measured_a == pytest.approx(20.0)
    assert corrected_a is None
    assert [each["name"] for each in bus.monitor.look(0.02)["branches"] if each["is_seen"]] == ["battery", "motor"]
    bus.pair("Battery", 0.3, 100.0, 90.0)
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
    assert any(line.endswith("corrupt 2, repeated 1, lost 1, corrected: corrupt 1") for line in bus.lines(0.06))


def test_monitor_shows_the_status_message_of_the_node(bus: Bus) -> None:
    bus.pair("Battery", 1.2, 100.0)
    bus.send("HV_BatteryCorrected", 1.201, BatteryCurrentCorrected=100.0, BatteryCurrentQuality=Quality.PASSED_THROUGH)
    said: dict[str, Any] = {"State": State.PASSING_THROUGH, "Reason": Reason.BRANCH_STALE, "ParameterSet": 44}
    bus.send("HV_CorrectionStatus", 1.0, **said, JunctionSumMeasured=-12.3, JunctionSumCorrected=0.4)
    node = bus.monitor.look(1.25)["node"]
    assert (node["state"], node["reason"], node["parameter_set"]) == ("PASSING_THROUGH", "BRANCH_STALE", 44)
    assert node["sums"] == {"measured_a": pytest.approx(-12.3), "corrected_a": pytest.approx(0.4)}
    assert (node["age_s"], node["is_silent"]) == (pytest.approx(0.25), False)
    lines = bus.lines(1.25)
    assert next(len(line) for line in lines if line.endswith("faults")) <= 80
    assert lines[0] == f"can0: node: {State.PASSING_THROUGH.words}; parameter set 44; status 0.2 s ago"
    assert lines[1] == f"because {Reason.BRANCH_STALE.words}"
    assert "node's sum, corrected: what its parameters would make of it; it publishes what was measured" in lines
    assert bus.lines(4.0)[0] == "can0: no node on this bus any more: its last status came 3.0 s ago"
    bus.send("HV_CorrectionStatus", 4.0, State=14, JunctionSumMeasured=-3276.8, JunctionSumCorrected=-3276.8)
    assert bus.monitor.look(4.0)["node"]["sums"] == {"measured_a": None, "corrected_a": None}
    assert bus.lines(4.0)[0] == "can0: node: state 14, which this version does not know; status 0.0 s ago"


def test_monitor_shows_silent_branches_bus_errors_and_unread_frames(make_database: MakeDatabase) -> None:
    """A small vehicle without a status message, whose heater is a power."""
    bus = Bus(make_database())
    lines = bus.lines(0.1, Counters(bus_errors=2, dropped=3))
    assert lines[0] == "can0: the layout has no status message: nothing is known of a node"
    assert "no frame of any branch: is the bus awake, and its bit rate the right one?" in lines
    assert "error frames of the bus: 2; a wrong bit rate, or a fault in the wiring?" in lines
    assert "frames that this computer was too slow to read: 3; they count as lost above" in lines
    bus.monitor.take((258, False), bytearray((40_000).to_bytes(2, "little")), 0.1)
    bus.monitor.take((512, True), bytearray((2000).to_bytes(4, "little")), 0.1)
    assert bus.branch(0.1, "heater")["measured_a"] == pytest.approx(-5.0)
    closed = view_lines(bus.monitor.look(0.1) | {"is_bus_open": False}, "can0", Counters())
    assert closed[0].startswith("can0: this computer's interface failed or is down; trying to open it again")


def test_monitor_once_prints_and_sends_nothing(database: VehicleDatabase, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the handlers of the tests stay
    counters = cycle(range(15))

    def count_on(message: can.Message) -> None:
        message.data = bytearray(protected(database, "HV_Battery", next(counters), BatteryCurrent=100.0))

    with can.Bus(interface="virtual", channel=CHANNEL) as bus:
        frame = can.Message(arbitration_id=0x110, is_extended_id=False, data=bytes(8))
        bus.send_periodic(frame, 0.01, modifier_callback=count_on)
        shown, reported = (ecu_node(*MONITOR, *more, "--once", "0.2") for more in (["--listen-only"], ["--json"]))
        bus.stop_all_periodic_tasks()
        assert bus.recv(0.0) is None
        silent = ecu_node(*MONITOR, "--once", "0.1")
    lines, document = shown.out.splitlines(), json.loads(reported.out)
    assert lines[0] == f"virtual {CHANNEL}: no node on this bus"
    assert next(line.split() for line in lines if line.startswith("battery"))[1] == "+100.00"
    assert lines[-1] == "no corrected messages on this bus: the currents are shown as they are on it"
    assert document["branches"][0]["measured_a"] == pytest.approx(100.0)
    assert document["is_bus_open"] is True
    line = f"ecu-node: virtual {CHANNEL}: no branch of {LAYOUT} was seen; see that the bus is the right one\n"
    assert (shown.code, reported.code, silent.code, silent.err) == (0, 0, 1, line)
    assert silent.out.splitlines()[-1].startswith("no frame of any branch")


def test_monitor_draws_a_table_in_a_terminal_and_exits_with_0_on_ctrl_c() -> None:
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
    lines = shown.decode().partition("\x1b[H")[2].partition("\x1b[J")[0].splitlines()
    first = [line.removeprefix("\x1b[K") for line in lines]  # cleared behind a full line, its last character would go
    assert first[0] == f"virtual {CHANNEL}: no node on this bus"
    assert len(first) == 6
    assert max(map(len, first)) <= 60
