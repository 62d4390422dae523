"""``ecu-node monitor`` on python-can's virtual bus: plain blocks, JSON, a real terminal, exit codes."""

import errno
import json
import os
import pty
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Never

import can
import pytest
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.virtual import VirtualBus

from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.cli import main
from ecu_node.core.status import Counters
from ecu_node.database import VehicleDatabase
from ecu_node.monitor import BusMonitor, listen_until
from tests.ecu_node.vehicles import LAYOUT, SMALL_DBC, SMALL_LAYOUT, protected

CHANNEL = "monitor"
MONITOR = ["monitor", "--layout", str(LAYOUT), "--interface", "virtual", "--channel", CHANNEL]


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Leave signal handlers as they were."""
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


def battery_frame(database: VehicleDatabase, counter: int) -> can.Message:
    data = protected(database, "HV_Battery", counter % 15, BatteryCurrent=100.0)
    return can.Message(arbitration_id=0x110, is_extended_id=False, data=data)


class FailingBus(VirtualBus):
    """A bus whose interface is down, as one of SocketCAN tells it."""

    def _recv_internal(self, timeout: float | None) -> Never:
        raise can.CanOperationError("Network is down", errno.ENETDOWN)


@contextmanager
def battery_on_bus(database: VehicleDatabase) -> Iterator[can.BusABC]:
    """A battery that sends; the bus to listen on whether anybody else does."""
    ended = threading.Event()

    def send(bus: can.BusABC) -> None:
        counter = 0
        while not ended.wait(0.01):
            bus.send(battery_frame(database, counter))
            counter += 1

    with can.Bus(interface="virtual", channel=CHANNEL) as bus:
        thread = threading.Thread(target=send, args=(bus,))
        thread.start()
        try:
            yield bus
        finally:
            ended.set()
            thread.join()


def test_once_prints_what_was_seen_and_sends_nothing(
    database: VehicleDatabase, capsys: pytest.CaptureFixture[str]
) -> None:
    with battery_on_bus(database) as bus:
        assert main([*MONITOR, "--once", "0.5"]) == 0
        assert bus.recv(0.0) is None
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"virtual {CHANNEL}: no node on this bus"
    battery = next(line.split() for line in lines if line.startswith("battery"))
    assert battery[1] == "+100.00"
    assert lines[-1] == "no corrected messages on this bus: the currents are shown as they are on it"


def test_once_as_json(database: VehicleDatabase, capsys: pytest.CaptureFixture[str]) -> None:
    with battery_on_bus(database):
        assert main([*MONITOR, "--once", "0.5", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["branches"][0]["measured_a"] == pytest.approx(100.0)
    assert document["branches"][0]["rate_hz"] > 0.0


def test_that_its_own_interface_is_down_stands_in_the_head_until_it_is_back(
    database: VehicleDatabase, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ecu_node.monitor.open_bus", lambda *_, channel, **__: FailingBus(channel))
    assert main([*MONITOR, "--once", "0.2"]) == 1
    captured = capsys.readouterr()
    lines = captured.out.splitlines()
    assert lines[0].startswith(
        f"virtual {CHANNEL}: this computer's interface failed or is down; trying to open it again"
    )
    assert "is the bus awake" not in captured.out
    assert main([*MONITOR, "--once", "0.2", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["is_bus_open"] is False
    kinds = iter([FailingBus])
    monkeypatch.setattr("ecu_node.monitor.open_bus", lambda *_, channel, **__: next(kinds, VirtualBus)(channel))
    with battery_on_bus(database):
        assert main([*MONITOR, "--once", "0.5"]) == 0
    assert capsys.readouterr().out.startswith(f"virtual {CHANNEL}: no node on this bus\n")


class SlowSocket(socket.socket):
    """A socket of which the kernel says that it has dropped three frames; a local one itself drops none."""

    def getsockopt(self, level: int, name: int, length: int = 4) -> bytes:  # type: ignore[override]
        return struct.pack("=9I", *8 * [0], 3) if name == 55 else super().getsockopt(level, name, length)


class FullBus(SocketcanBus):
    """A bus as of SocketCAN with an error frame."""

    def __init__(self) -> None:
        near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket, self.channel_info = SlowSocket(fileno=near.detach()), "a pair of sockets"
        self.far.send(struct.pack("=IB3x8s", 0x20000004, 8, bytes(8)))

    def shutdown(self) -> None:
        self.socket.close()
        self.far.close()


def test_error_frames_and_frames_that_were_not_read_in_time_are_told_below(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ecu_node.monitor.open_bus", lambda *_, **__: FullBus())
    assert main([*MONITOR, "--once", "0.2"]) == 1
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "error frames of the bus: 1; a wrong bit rate, or a fault in the wiring?",
        "frames that this computer was too slow to read: 3; they count as lost above",
    ]


def test_a_bus_without_any_branch_ends_in_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*MONITOR, "--once", "0.1"]) == 1
    captured = capsys.readouterr()
    assert (
        captured.err
        == f"ecu-node: virtual {CHANNEL}: no branch of {LAYOUT} was seen; see that the bus is the right one\n"
    )
    assert captured.out.splitlines()[-1].startswith("no frame of any branch")


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_without_a_terminal_a_block_comes_per_second_until_a_signal(
    how: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    timer = threading.Timer(1.3, os.kill, (os.getpid(), how))
    timer.start()
    start_s = time.monotonic()
    assert main(MONITOR) == 0
    timer.join()
    assert time.monotonic() - start_s < 10.0
    blocks = capsys.readouterr().out.strip().split("\n\n")
    assert len(blocks) == 2
    assert all(block.startswith(f"virtual {CHANNEL}: no node on this bus\n ") for block in blocks)
    assert all(block.splitlines()[2].startswith("branch ") for block in blocks)


def test_with_standard_output_closed_it_listens_until_a_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    timer = threading.Timer(1.3, os.kill, (os.getpid(), signal.SIGTERM))
    monkeypatch.setattr(sys, "stdout", None)
    timer.start()
    assert main(MONITOR) == 0
    timer.join()


def in_terminal(columns: int, lines: int) -> tuple[int, str]:
    """Exit code of a monitor that was interrupted once it had drawn, and what the terminal got."""
    ours, theirs = pty.openpty()
    size = {"COLUMNS": str(columns), "LINES": str(lines)}
    shown = b""
    with subprocess.Popen(
        [sys.executable, "-m", "ecu_node", *MONITOR],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env={**os.environ, "TERM": "xterm", **size},
    ) as process:
        os.close(theirs)
        while b"\x1b[J" not in shown:
            shown += os.read(ours, 65536)
        process.send_signal(signal.SIGINT)
        try:
            while chunk := os.read(ours, 65536):
                shown += chunk
        except OSError:  # EIO: the terminal has no other end any more
            pass
        code = process.wait(timeout=60)
    os.close(ours)
    return code, shown.decode().replace("\r\n", "\n")


def drawn(text: str) -> list[str]:
    """Lines of the first picture, without styles."""
    first = text.partition("\x1b[H")[2].partition("\x1b[J")[0]
    return re.sub(r"\x1b\[[0-9;]*[mK]", "", first).splitlines()


def test_in_a_terminal_a_table_is_drawn_and_ctrl_c_ends_it_with_0() -> None:
    code, text = in_terminal(120, 24)
    assert code == 0
    assert "\x1b[?1049h" in text  # on a screen of its own, which is given back
    assert "\x1b[2mmotor_rear" in text  # dim
    before, _, after = text.rpartition("\x1b[?1049l")
    assert drawn(before)[0] == f"virtual {CHANNEL}: no node on this bus"
    assert after.splitlines() == drawn(before)  # what was seen last stays on the screen


@pytest.mark.parametrize("columns", [34, 60, 80, 160])
def test_a_terminal_of_any_width_shows_everything(columns: int) -> None:
    lines = drawn(in_terminal(columns, 50)[1])
    assert max(map(len, lines)) <= columns
    words = " ".join(lines).split()
    for branch in ("battery", "motor", "motor_rear"):
        assert words[words.index(branch) + 1 :][:9] == [*7 * ["-"], "not", "fitted?"]


def test_a_low_terminal_shows_the_first_lines_and_says_how_many_are_missing() -> None:
    whole, low = drawn(in_terminal(80, 24)[1]), drawn(in_terminal(80, 7)[1])
    assert len(whole) <= 23
    assert low == [*whole[:5], f"{len(whole) - 5} more lines do not fit"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--json"], "--json needs --once SECONDS"),
        (["--once", "0"], "expected a number of seconds above 0"),
        (["--once", "nan"], "expected a number of seconds above 0"),
        (["--once", "soon"], "expected a number of seconds above 0"),
        (["--params", "p.json"], "unrecognized arguments"),
    ],
)
def test_wrong_use_ends_in_2(options: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([*MONITOR, *options])
    assert caught.value.code == 2
    assert words in capsys.readouterr().err


def test_help_is_given(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["monitor", "--help"])
    assert caught.value.code == 0
    assert "Listens to a bus, and never sends" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("layout", "interface", "words"),
    [
        ("missing.toml", "virtual", "ecu-node: missing.toml: cannot read the layout: "),
        (str(LAYOUT), "carrier_pigeon", "ecu-node: carrier_pigeon nobus0: cannot open the bus: "),
        (str(LAYOUT), "socketcan", "ecu-node: socketcan nobus0: cannot open the bus: "),
    ],
)
def test_what_keeps_it_from_listening_is_one_line(
    layout: str, interface: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["monitor", "--layout", layout, "--interface", interface, "--channel", "nobus0", "--once", "1"]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(words)
    assert captured.err.count("\n") == 1


def test_a_layout_that_needs_can_fd_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small.toml").write_text(SMALL_LAYOUT)
    (tmp_path / "small.dbc").write_text(SMALL_DBC.replace("PairOut: 8", "PairOut: 16"))
    command = ["monitor", "--layout", str(tmp_path / "small.toml"), "--interface", "virtual", "--channel", CHANNEL]
    assert main([*command, "--once", "0.1"]) == 1
    assert "CAN FD messages (PairOut); start with --fd" in capsys.readouterr().err


def test_of_many_frames_none_is_left_out(database: VehicleDatabase) -> None:
    """All that are there at once are taken in one turn, remote frames left alone."""
    counters = Counters()
    bus = SteadyBus(lambda: can.Bus(interface="virtual", channel=CHANNEL), counters)
    with can.Bus(interface="virtual", channel=CHANNEL) as other:
        for counter in range(5000):
            other.send(battery_frame(database, counter))
            other.send(can.Message(arbitration_id=0x110, is_extended_id=False, is_remote_frame=True))
        start_s = time.monotonic()
        monitor = BusMonitor(database, start_s)
        listen_until(bus, monitor, start_s + 5.0, lambda: time.monotonic() > start_s + 1.0)
        bus.close()
    battery = monitor.look(start_s + 1.0).branches[0]
    assert battery.rate_hz == pytest.approx(5000.0)
    assert not any(battery.faults.values())
