"""Messages to the service manager over a real socket, and the log's rate limit."""

import errno
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from ecu_node.bus.service import Log, ServiceManager, be_real_time
from tests.ecu_node.processes import ServiceManagerHere


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


@pytest.fixture
def managed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ServiceManagerHere]:
    """A service manager whose watchdog expects a message every 4 s."""
    manager = ServiceManagerHere(tmp_path / "notify", monkeypatch)
    monkeypatch.setenv("WATCHDOG_USEC", "4000000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    with manager.socket:
        yield manager


def test_watchdog_is_fed_at_half_its_timeout(managed: ServiceManagerHere) -> None:
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


def test_repeated_log_line_is_held_back(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    log = Log()
    for tenth in range(201):
        monkeypatch.setattr("ecu_node.bus.service.time.monotonic", lambda now_s=0.1 * tenth: now_s)
        log.say("bus gone")
    assert capsys.readouterr().err.splitlines() == [
        *3 * ["ecu-node: bus gone"],
        "ecu-node: bus gone (and 97 times before)",
        *2 * ["ecu-node: bus gone"],
        "ecu-node: bus gone (and 97 times before)",
    ]


def test_closed_log_does_not_end_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w", buffering=1) as gone:
        monkeypatch.setattr(sys, "stderr", gone)
        Log().say("nobody reads this")
        monkeypatch.undo()
        os.dup2(os.open(os.devnull, os.O_WRONLY), gone.fileno())  # what is left in its buffer can be closed


def test_missing_real_time_permissions_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """The memory lock is refused by the C library, whose error number says why."""

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
