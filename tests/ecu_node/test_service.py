"""The node as a service: its log, the service manager, real time, and signals while it starts.

A signal comes at a moment found by Python's audit events: the process sends it to itself, and nothing else is changed.
"""

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import pytest

from ecu_node.bus.run import StateChanges
from ecu_node.bus.service import Log, ServiceManager, be_real_time
from ecu_node.bus.wiring import InForce, Mode, put_in_force
from ecu_node.core.status import Reason
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters
from tests.ecu_node.processes import ServiceManagerHere, bench_node, running
from tests.ecu_node.vehicles import LAYOUT, answers, battery, corrector_for, parameters_for


def test_log_that_nobody_reads_does_not_block_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    with os.fdopen(writer, "w") as full, os.fdopen(reader, "rb") as reading:
        monkeypatch.setattr(sys, "stderr", full)
        log = Log()
        start_s = time.monotonic()
        for number in range(5000):
            log.say(f"line {number} {'x' * 50}")
        assert time.monotonic() - start_s < 5.0
        os.read(reader, 1 << 20)
        log.say("after all")
        last = os.read(reader, 1 << 20).decode()
        assert not reading.closed
    assert "ecu-node: after all (" in last
    assert "lines before were lost: nobody read them)" in last


def test_lines_of_several_threads_are_not_mixed(monkeypatch: pytest.MonkeyPatch) -> None:
    class Slow(StringIO):
        def write(self, text: str) -> int:
            time.sleep(0.001)
            return super().write(text)

    monkeypatch.setattr(sys, "stderr", written := Slow())
    log = Log()
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(lambda number: log.say(f"line {number}"), range(40)))
    assert sorted(written.getvalue().splitlines()) == sorted(f"ecu-node: line {number}" for number in range(40))


@pytest.fixture
def managed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ServiceManagerHere]:
    """A service manager whose watchdog expects a message every 4 s."""
    manager = ServiceManagerHere(tmp_path / "notify", monkeypatch)
    monkeypatch.setenv("WATCHDOG_USEC", "4000000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    with manager.socket:
        yield manager


def test_watchdog_is_fed_at_intervals_of_half_its_timeout(managed: ServiceManagerHere) -> None:
    service = ServiceManager()
    fed_s = []
    for tick in range(100):
        now_s = 1000.0 + 0.1 * tick
        service.alive(now_s)
        if managed.told() == ["WATCHDOG=1"]:
            fed_s.append(now_s)
    assert fed_s == pytest.approx([1000.0, 1002.0, 1004.0, 1006.0, 1008.0], abs=0.11)


def test_service_manager_that_does_not_read_does_not_block_the_node(managed: ServiceManagerHere) -> None:
    service = ServiceManager()
    start_s = time.monotonic()
    told = int(Path("/proc/sys/net/unix/max_dgram_qlen").read_text()) + 3
    for number in range(told):
        service.status(str(number))
    assert time.monotonic() - start_s < 5.0
    assert len(managed.told()) < told


def test_repeated_log_lines_are_counted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    log = Log()
    for tenth in range(201):
        monkeypatch.setattr("ecu_node.bus.service.time.monotonic", lambda now_s=0.1 * tenth: now_s)
        log.say("bus gone")
    gone, counted = "ecu-node: bus gone", "ecu-node: bus gone (and 97 times before)"
    assert capsys.readouterr().err.splitlines() == [gone, gone, gone, counted, gone, gone, counted]


def test_closed_log_does_not_end_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w", buffering=1) as gone:
        monkeypatch.setattr(sys, "stderr", gone)
        Log().say("nobody reads this")
        monkeypatch.undo()
        os.dup2(os.open(os.devnull, os.O_WRONLY), gone.fileno())  # what is left in its buffer can be closed


def test_real_time_log_line_names_the_permissions_that_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Setting SCHED_FIFO raises an error; mlockall of the C library fails, and errno says why."""

    def refused(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    processors: list[object] = []
    monkeypatch.setattr("os.sched_setscheduler", refused)
    monkeypatch.setattr("os.sched_setaffinity", lambda _, allowed: processors.extend(allowed))
    monkeypatch.setattr("resource.setrlimit", lambda *_: None)
    monkeypatch.setattr("ctypes.CDLL", lambda *_, **__: SimpleNamespace(mlockall=lambda _: -1))
    monkeypatch.setattr("ctypes.get_errno", lambda: errno.EPERM)
    why = "[Errno 1] Operation not permitted"
    assert be_real_time() == f"real time, but not allowed: SCHED_FIFO ({why}), memory lock ({why})"
    assert len(processors) == 1


# ---- lines of the log: begin and end of each fall-back and of each silence of the bus, once each

FALLS_BACK = "passing measured values through until"


class Node:
    """The core of a node whose battery may send, and what it logs of its state."""

    def __init__(self, database: VehicleDatabase, *, has_memory: bool = True) -> None:
        self.database, self.now_s = database, 0.0
        self.corrector = corrector_for(database, battery=(0.0, 5.0))
        self.changes = StateChanges(self.corrector, has_memory=has_memory)

    def drive(self) -> str | None:
        answers(self.corrector, battery(self.database, round(self.now_s) % 15), self.now_s)
        return self.later(0.02)

    def later(self, seconds: float) -> str | None:
        self.now_s += seconds
        self.corrector.look(self.now_s)
        news = self.changes.news()
        assert self.changes.news() is None, "once each"
        return news

    def latch(self, reason: Reason, *branches: str) -> str | None:
        self.corrector.latch(reason, branches)
        return self.changes.news()

    def load(self, parameters: VehicleParameters | None) -> str | None:
        in_force = InForce(parameters=parameters, reason=Reason.NONE if parameters else Reason.REVOKED)
        put_in_force(self.corrector, self.database, in_force, self.now_s, mode=Mode.OVERLAY)
        return self.changes.news()


@pytest.mark.parametrize("before", [Reason.NONE, Reason.BRANCH_STALE])
@pytest.mark.parametrize("revoked", [False, True])
def test_start_and_end_of_bus_silence_are_logged_once(database: VehicleDatabase, before: Reason, revoked: bool) -> None:
    """In the same way after a fall-back, and without parameters."""
    node = Node(database)
    assert node.drive() is None
    node.latch(before, "motor")
    if revoked:
        assert node.load(None) is None, "it does not correct again"
    for _ in range(2):
        assert [node.later(1.0), node.later(6.0), node.drive()] == ["no branch sends", None, "branches send again"]


def test_log_gives_reason_and_end_condition_of_a_fall_back_and_its_end(database: VehicleDatabase) -> None:
    node = Node(database)
    stuck = node.latch(Reason.BRANCH_STUCK, "motor", "dcdc")
    assert stuck == f"{FALLS_BACK} the bus has slept: {Reason.BRANCH_STUCK.words} (motor, dcdc)"
    wrong = node.latch(Reason.SUM_IMPLAUSIBLE, "motor", "dcdc")
    until = f"{FALLS_BACK} other parameters or 'ecu-node clear'"
    assert wrong == f"{until}: {Reason.SUM_IMPLAUSIBLE.words} (motor or dcdc)"
    assert node.latch(Reason.CORRECTION_WORSE) == f"{until}: {Reason.CORRECTION_WORSE.words}"
    assert node.load(parameters_for(database, battery=(0.0, 5.0))) == "correcting again"
    alone = Node(database, has_memory=False)
    assert f"{FALLS_BACK} a restart: " in (alone.latch(Reason.CORRECTION_WORSE) or "")


def test_revocation_during_bus_sleep_is_not_logged_as_waking_up(database: VehicleDatabase) -> None:
    node = Node(database)
    assert [node.drive(), node.later(1.0)] == [None, "no branch sends"]
    assert node.load(None) is None


DOWN = """
import errno, sys
from can.interfaces.virtual import VirtualBus
receive, failures = VirtualBus._recv_internal, iter(range(5))
def receive_once_up(bus, timeout):
    if next(failures, None) is not None:
        raise OSError(errno.ENETDOWN, "Network is down")
    return receive(bus, timeout)
VirtualBus._recv_internal = receive_once_up
from ecu_node.__main__ import ecu_node_program
sys.argv[1:] = {arguments!r}
sys.exit(ecu_node_program())
"""


def test_node_says_that_it_runs_once_its_bus_is_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = bench_node(tmp_path, "down")
    manager = ServiceManagerHere(tmp_path / "notify", monkeypatch)
    with manager.socket, running(program=["-c", DOWN.format(arguments=arguments)]) as log:
        events = [line for line in log if "bus" in line or "running" in line]
        waiting, working = manager.wait_for("READY"), manager.wait_for("STATUS")
    assert ["failed" in events[0], "open again" in events[1], "running on virtual down" in events[2]] == [True] * 3
    assert (waiting, working) == ("READY=1\nSTATUS=waiting for the bus", "STATUS=correcting nothing")


# ---- signals at the very moment when the node opens its layout, or begins to import a library

AT = """
import signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whatever the tests were started with
def hook(event, arguments):
    if event == {event!r} and str(arguments[0]) == {what!r}:
        signal.raise_signal({number})
sys.addaudithook(hook)
from ecu_node.__main__ import ecu_node_program
sys.argv[1:] = {arguments!r}
sys.exit(ecu_node_program())
"""
MOMENTS = [("import", "can"), ("open", str(LAYOUT))]


def program(event: str, what: str, number: int, arguments: list[str]) -> list[str]:
    return [sys.executable, "-c", AT.format(event=event, what=what, number=int(number), arguments=arguments)]


CHECK = ["check", "--params", "none.json", "--layout", str(LAYOUT)]


@pytest.mark.parametrize(("event", "what"), [("import", "ecu_node.cli"), *MOMENTS])
def test_ctrl_c_during_startup_prints_one_line_and_exits_with_130(event: str, what: str) -> None:
    command = program(event, what, signal.SIGINT, CHECK)
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "ecu-node: interrupted\n")
    for nobody in ("2>&-", "2>/dev/full"):
        shell = ["sh", "-c", f'"$@" {nobody}', "sh", *command]
        silent = subprocess.run(shell, stdout=subprocess.PIPE, check=False)
        assert (silent.returncode, silent.stdout) == (130, b"")


@pytest.mark.parametrize(("event", "what"), MOMENTS)
def test_sighup_during_startup_does_not_end_a_node(tmp_path: Path, event: str, what: str) -> None:
    _, *program_text = program(event, what, signal.SIGHUP, bench_node(tmp_path, "hangup"))
    with running(program=program_text) as log:
        assert "running on virtual hangup" in log[-1]


def test_sighup_ends_commands_other_than_run() -> None:
    command = program("open", str(LAYOUT), signal.SIGHUP, CHECK)
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == -signal.SIGHUP
