"""Telemetry and the histogram of latencies: neither delays or ends the correction, and lost lines are counted."""

import json
import os
import runpy
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import can
import pytest

from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.telemetry import Telemetry
from ecu_node.bus.wiring import Mode
from ecu_node.core.status import Counters, Latency
from ecu_node.database import VehicleDatabase
from tests.ecu_node.processes import bench_node, running, wait_until
from tests.ecu_node.vehicles import PAIR, SMALL_LAYOUT, Frame, MakeDatabase, answers, corrector_for

ROOT = Path(__file__).parents[2]
VSS = "Vehicle.Powertrain.TractionBattery.CurrentCurrent"
NAMED = SMALL_LAYOUT.replace('name = "battery", ', f'name = "battery", vss = "{VSS}", ')
CURRENTS = bytes.fromhex("0320f9c000000000")
"""80 A from battery to motor."""


class Outlet:
    """Telemetry of a node on the small vehicle."""

    def __init__(self, database: VehicleDatabase, target: Path | tuple[str, int]) -> None:
        self.corrector = corrector_for(database, Mode.OVERLAY, time.monotonic(), battery=(0.25, 5.0))
        self.bus = SteadyBus(lambda: can.Bus("telemetry", "virtual"), self.corrector.counters)
        self.said: list[str] = []
        options: Any = {"layout": database.layout, "latency": Latency(), "buses": [self.bus], "say": self.said.append}
        self.telemetry = Telemetry(target, self.corrector, **options)
        self.now_s = time.monotonic() - 1.0

    def wait_for_loss(self, count: int) -> None:
        wait_until(lambda: self.corrector.counters.telemetry_lost >= count)

    def second(self) -> None:
        """Take a frame of battery and motor, and do what is done once per second."""
        self.now_s += 1.0
        answers(self.corrector, Frame(PAIR, CURRENTS), self.now_s)
        self.corrector.look(self.now_s)
        self.telemetry.look(self.now_s)


@pytest.fixture
def make_outlet(make_database: MakeDatabase) -> Iterator[Callable[..., Outlet]]:
    with ExitStack() as opened:

        def make(target: Path | tuple[str, int]) -> Outlet:
            outlet = Outlet(make_database(NAMED), target)
            opened.callback(outlet.bus.close)
            return outlet

        yield make


def lines_of(path: Path, count: int) -> list[dict[str, Any]]:
    wait_until(lambda: path.exists() and path.read_text().count("\n") >= count)
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_telemetry_line_has_currents_by_vss_name_sums_state_and_counters(make_outlet: Any, tmp_path: Path) -> None:
    outlet = make_outlet(tmp_path / "node.jsonl")
    outlet.telemetry.latency.add(100e-6)
    outlet.second()
    outlet.telemetry.look(outlet.now_s + 0.5)  # a line per second
    (line,) = lines_of(tmp_path / "node.jsonl", 1)
    assert line["branches"] == {
        VSS: {"measured_a": 80.0, "corrected_a": 60.0, "quality": "CORRECTED"},
        "motor": {"measured_a": -80.0, "corrected_a": -80.0, "quality": "PASSED_THROUGH"},
        "heater": {"measured_a": None, "corrected_a": None, "quality": "NOT_AVAILABLE"},
    }
    assert (line["sum_measured_a"], line["sum_corrected_a"]) == (0.0, -20.0)
    assert (line["state"], line["reason"], line["parameter_set"]) == ("CORRECTING", "NONE", 300)
    assert line["counters"].keys() == vars(Counters()).keys()
    assert line["counters"]["frames_in"] == 1
    assert list(line["buses"].values()) == ["open"]
    assert (line["latency_us"], sum(line["latency_counts"])) == ({"p50": 100, "p99.9": 100, "max": 100}, 1)
    assert abs((datetime.now(UTC) - datetime.fromisoformat(line["time"])).total_seconds()) < 60.0


def test_telemetry_lines_are_sent_by_udp(make_outlet: Any) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10.0)
        make_outlet(receiver.getsockname()).second()
        assert json.loads(receiver.recv(65536))["branches"][VSS]["corrected_a"] == 60.0


def test_telemetry_lines_lost_on_a_full_disk_are_counted_and_logged_once(make_outlet: Any, tmp_path: Path) -> None:
    path = tmp_path / "link"
    path.symlink_to("/dev/full")
    outlet = make_outlet(path)
    for count in (1, 2, 3):
        outlet.second()
        outlet.wait_for_loss(count)
    assert outlet.said == ["--telemetry: No space left on device; lines are lost until that has changed"]
    path.unlink()
    outlet.second()
    lines_of(path, 1)
    wait_until(lambda: len(outlet.said) == 2)
    assert outlet.said[1] == "--telemetry: lines are written again"


@pytest.mark.parametrize(
    "target",
    [".", "pipe", ("no-such-host.invalid", 5000), ("a" * 64, 5000)],
    ids=["folder", "pipe", "unknown host", "impossible host"],
)
def test_unusable_target_blocks_nothing(target: str | tuple[str, int], make_outlet: Any, tmp_path: Path) -> None:
    """A folder, a pipe without a reader, a host without an address, and one that no name server could know."""
    os.mkfifo(tmp_path / "pipe")
    outlet = make_outlet(tmp_path / target if isinstance(target, str) else target)
    start_s = time.monotonic()
    for _ in range(5):
        outlet.second()
    assert time.monotonic() - start_s < 1.0
    outlet.wait_for_loss(3)
    wait_until(lambda: outlet.said)
    assert outlet.said[0].endswith("; lines are lost until that has changed")


def test_telemetry_line_is_dropped_while_the_writer_is_busy(make_outlet: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def look_up(*_: object, **__: object) -> None:
        """As where no name server answers."""
        answered.wait(10.0)
        raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")

    answered = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    outlet = make_outlet(("somewhere", 5000))
    for _ in range(5):
        outlet.second()
    assert outlet.corrector.counters.telemetry_lost in {3, 4}  # one is being sent, one waits
    answered.set()


def test_mqtt_example_extracts_the_currents_from_a_line(make_outlet: Any, tmp_path: Path) -> None:
    make_outlet(tmp_path / "node.jsonl").second()
    lines_of(tmp_path / "node.jsonl", 1)
    currents = runpy.run_path(str(ROOT / "examples" / "telemetry_to_mqtt.py"))["currents"]
    assert currents((tmp_path / "node.jsonl").read_text()) == {VSS: -60.0, "motor": -80.0}


def test_partly_written_line_is_removed(make_outlet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, write = tmp_path / "node.jsonl", os.write
    outlet = make_outlet(path)
    monkeypatch.setattr(os, "write", lambda file, line: write(file, line[:7] if line.startswith(b'{"time"') else line))
    outlet.second()
    outlet.wait_for_loss(1)
    assert path.read_bytes() == b""


def test_latency_histogram_has_bins_of_powers_of_two_in_microseconds(monkeypatch: pytest.MonkeyPatch) -> None:
    latency = Latency()
    monkeypatch.setattr(time, "monotonic", lambda: 100.0)
    for later_s, frames in ((3.0, 1), (0.1, 1), (100e-6, 900), (100e-6, 98)):
        for k in range(frames):
            latency.came(100.0 - later_s + 1e-8 * k)  # the first one has waited longest
        latency.sent(0)
    assert (latency.counts[7], latency.counts[17], latency.counts[22], sum(latency.counts)) == (998, 1, 1, 1000)
    assert latency.at_most_s(0.5) == pytest.approx(128e-6)
    assert latency.at_most_s(0.999) == pytest.approx(0.131072)
    assert latency.at_most_s(1.0) == latency.largest_s == 3.0
    latency.came(0.0)
    latency.sent(1)  # an answer that the bus did not take is none
    latency.sent(0)
    assert sum(latency.counts) == 1000


def test_internal_error_in_telemetry_does_not_stop_the_correction(tmp_path: Path) -> None:
    broken = "from ecu_node.bus.telemetry import Telemetry; Telemetry._record = lambda *_: 1 / 0"
    code = f"import sys; from ecu_node.cli import run_ecu_node; {broken}; sys.exit(run_ecu_node(sys.argv[1:]))"
    options = [*bench_node(tmp_path, "records"), "--telemetry", str(tmp_path / "node.jsonl")]
    fault = "internal error in Telemetry, which is off now; please report it: ZeroDivisionError"
    with running(*options, program=("-c", code), until=fault) as log:
        assert fault in log[-1]
