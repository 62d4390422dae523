"""How an adapter is opened: its speed, python-can's configuration, a dry run, and a node that only listens.

An slcan adapter is a pseudo-terminal whose other end speaks the protocol; networks are those of python-can.
"""

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from can.typechecking import BitTimingFdDict

from ecu_node.bus.adapters import bus_config, connect
from ecu_node.cli import main
from ecu_node.errors import BusError
from ecu_node.parameters import write_parameters
from tests.ecu_node.vehicles import SMALL_DBC, MakeDatabase, parameters_for

_FD_VALUES = (80_000_000, 2, 63, 16, 16, 2, 15, 4, 4)
FD_TIMING = dict(zip(BitTimingFdDict.__annotations__, _FD_VALUES, strict=True))
"""500 kbit/s and 2 Mbit/s, both sampled at 80 %."""
FD_RATES = {"fd": True, "bitrate": 500_000, "data_bitrate": 2_000_000}
CLASSIC_TIMING = {"f_clock": 8_000_000, "brp": 2, "tseg1": 13, "tseg2": 2, "sjw": 1, "nof_samples": 1}
"""250 kbit/s, sampled at 87.5 %."""
DATABASE = cantools.database.can.Database()
DATABASE.add_dbc_string(SMALL_DBC)
PAIR, ANSWER = DATABASE.get_message_by_name("Pair"), DATABASE.get_message_by_name("PairOut")
BATTERY_A, CORRECTED_A = 111.0, 100.0
"""Of a battery with a gain error of +0.1 and an offset of 1 A. [A]"""


@pytest.fixture(autouse=True)
def _no_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the configuration of who runs the tests; HOME holds can.conf."""
    for name in ("CAN_CONFIG", "CAN_BITRATE", "CAN_INTERFACE", "CAN_CHANNEL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))


@pytest.fixture
def node(make_database: MakeDatabase, tmp_path: Path) -> list[str]:
    """Options of a node for the small vehicle."""
    database = make_database()
    write_parameters(parameters_for(database, battery=(0.1, 1.0)), tmp_path / "v1.json")
    layout = ["--layout", str(database.layout.path)]
    return ["run", "--unsigned", "--params", str(tmp_path / "v1.json"), *layout, "--vehicle", "v1"]


# ---- the speed of a bus


@pytest.mark.parametrize(
    ("interfaces", "config", "settings", "words"),
    [
        (
            "pcan kvaser vector slcan gs_usb ixxat cantact",
            {},
            {},
            "no bitrate: .* give ecu-node --bitrate BIT_PER_S, or",
        ),
        ("kvaser vector ixxat", {}, {"fd": True, "bitrate": 500_000}, "no data_bitrate: .* --data-bitrate BIT_PER_S"),
        ("pcan slcan nixnet", {}, FD_RATES, r"CAN FD needs its bit timing: f_clock, .* in section \[1\] of can.conf"),
        ("socketcan virtual udp_multicast serial", {}, {"bitrate": 250_000}, "the bit rate of .* is not set from here"),
        ("pcan", {"bitrate": "250k"}, {}, "bitrate = 250k: a number of bit/s is expected"),
        ("pcan", {"bitrate": -1}, {}, "bitrate = -1: a number of bit/s is expected"),
        ("pcan", {"bitrate": 83_300}, {}, "bitrate = 83300: pcan has 1000000, .*; or give the bit timing"),
        ("pcan", {"f_clock": 8_000_000, "bitrate": 250_000}, {}, "incomplete, .* classic CAN .* brp, tseg1"),
        ("pcan", FD_TIMING, {}, "not one of classic CAN"),
        ("pcan", CLASSIC_TIMING, {"fd": True}, "not one of CAN FD, which has f_clock, nom_brp"),
        (
            "pcan",
            {**CLASSIC_TIMING, "bitrate": 500_000},
            {},
            "bitrate = 500000 contradicts the bit timing .BR: 250_000",
        ),
        ("pcan", {**FD_TIMING, "data_bitrate": 4_000_000}, {"fd": True}, "data_bitrate = 4000000 contradicts"),
        ("ixxat", CLASSIC_TIMING, {}, "python-can cannot set a bit timing there; take f_clock out"),
    ],
)
def test_speed_that_would_be_another_one_is_refused(
    interfaces: str, config: dict[str, object], settings: Any, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAN_CONFIG", json.dumps(config))
    for interface in interfaces.split():
        with pytest.raises(BusError, match=f"^{interface} 1: .*{words}"):
            connect(interface, "1", **settings)


# ---- python-can's configuration


def test_each_channel_has_its_section_and_the_command_line_goes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "can.conf").write_text("[default]\nbitrate = 125000\n[1]\nbitrate = 250000\nserial = 1234\n")
    assert bus_config("vector", "1") == {"interface": "vector", "channel": 1, "bitrate": 250_000, "serial": 1234}
    assert bus_config("vector", "2")["bitrate"] == 125_000
    rates = bus_config("kvaser", "1", fd=True, bitrate=500_000, data_bitrate=2_000_000)
    assert (rates["fd"], rates["bitrate"], rates["data_bitrate"]) == (True, 500_000, 2_000_000)
    assert bus_config("vector", "1", bitrate=500_000, data_bitrate=None)["bitrate"] == 500_000
    monkeypatch.setenv("CAN_BITRATE", "100000")
    assert bus_config("vector", "1")["bitrate"] == 100_000


@pytest.mark.parametrize(("timing", "fd"), [(FD_TIMING, True), (CLASSIC_TIMING, False)])
def test_bit_timing_of_can_conf_reaches_the_driver(timing: dict[str, int], fd: bool, tmp_path: Path) -> None:
    lines = [f"{name} = {value}" for name, value in timing.items()]
    (tmp_path / "can.conf").write_text("\n".join(["[PCAN_USBBUS1]", *lines]))
    found = bus_config("pcan", "PCAN_USBBUS1", fd=fd)["timing"]
    assert isinstance(found, can.BitTimingFd if fd else can.BitTiming)
    assert dict(found) == timing


# ---- a dry run


def test_dry_run_prints_what_would_be_opened_and_opens_nothing(
    node: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    adapter = ["--interface", "pcan", "--channel", "PCAN_USBBUS1"]  # its library is not here: opening it would fail
    assert main([*node, *adapter, "--bitrate", "250000", "--dry-run"]) == 0
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [
        "would open pcan PCAN_USBBUS1: bitrate 250000",
        "  reads Pair (0x100), Heater (0x200), Net (0x102)",
        "  sends PairOut (0x200)",
    ]
    assert main([*node, *adapter, "--bitrate", "250000", "--dry-run", "--params", "none.json"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("would correct nothing: none.json: no such parameter")
    assert captured.err == ""
    assert main([*node, *adapter, "--dry-run"]) == 1
    assert "no bitrate" in capsys.readouterr().err


def test_dry_run_of_a_gateway_prints_both_ways(node: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*node, "--interface", "virtual", "--channel", "a", "--gateway", "b", "--dry-run"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "would open virtual a: no settings",
        "  reads all frames; corrects Pair (0x100), Heater (0x200)",
        "  sends all other frames of the other bus, as they are",
        "would open virtual b: no settings",
        "  reads all frames",
        "  sends Pair (0x100), Heater (0x200), corrected; nothing; all other frames of the other bus, as they are",
    ]


# ---- listening only


@pytest.mark.parametrize(
    ("interface", "words"),
    [
        ("slcan", "nothing is sent, and no frame acknowledged"),
        ("gs_usb", "the adapter acknowledges frames, as python-can has no listen-only mode of gs_usb"),
        ("socketcan", r"acknowledges frames, unless .*'ip link set c0 type can listen-only on'"),
        ("virtual", "nothing is sent$"),
    ],
)
def test_listen_only_says_whether_the_adapter_acknowledges(
    interface: str, words: str, node: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    rate = ["--bitrate", "250000"] if interface in {"slcan", "gs_usb"} else []
    assert main([*node, "--interface", interface, "--channel", "c0", *rate, "--listen-only", "--dry-run"]) == 0
    *_, sends, last = capsys.readouterr().out.splitlines()
    assert sends == "  sends nothing"
    assert re.search(words, last)


def test_gateway_that_only_listens_is_refused(node: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*node, "--channel", "c0", "--gateway", "c1", "--listen-only"]) == 2
    assert "--listen-only sends nothing, and a gateway must pass frames on" in capsys.readouterr().err


@contextmanager
def running(*options: str) -> Iterator[list[str]]:
    """A node in a process of its own, at work; the lines of its log, all of them after the block."""
    command = [sys.executable, "-m", "ecu_node", *options]
    environment = {**os.environ, "CAN_CONFIG": os.environ.get("CAN_CONFIG", '{"sleep_after_open": 0}')}
    log: list[str] = []
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stderr is not None
        try:
            for line in process.stderr:
                log.append(line)
                if "running on" in line:
                    break
            yield log
        finally:
            process.send_signal(signal.SIGTERM)
            log += process.stderr.readlines()
            assert process.wait(timeout=30) == 0, log


class SlcanAdapter:
    """The adapter's end of a serial line: takes commands and frames, and says OK, as LAWICEL's protocol has it."""

    def __init__(self) -> None:
        self._here, self._there = pty.openpty()
        tty.setraw(self._there)
        self.path = os.ttyname(self._there)
        self.lines: list[bytes] = []
        """All that came, each without its carriage return."""
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def _read(self) -> None:
        rest = b""
        while not rest.endswith(b"END"):
            *lines, rest = (rest + os.read(self._here, 4096)).split(b"\r")
            self.lines += lines
            os.write(self._here, b"\r" * len(lines))

    def put(self, frame: bytes) -> None:
        """Say that a frame came over the bus."""
        os.write(self._here, frame + b"\r")

    def close(self) -> None:
        """Unplug it."""
        os.write(self._there, b"END")
        self._reading.join()
        os.close(self._here)
        os.close(self._there)


@pytest.fixture
def adapter() -> Iterator[SlcanAdapter]:
    pytest.importorskip("serial", reason="python-can's slcan needs pyserial")
    adapter = SlcanAdapter()
    yield adapter
    adapter.close()


MEASURED = PAIR.encode({"Battery": BATTERY_A, "Motor": CORRECTED_A})
FRAME = b"t1008" + MEASURED.hex().upper().encode()


def fed(adapter: SlcanAdapter, enough: Callable[[], bool]) -> None:
    """Send frames of the sensors every 20 ms, until it is enough, or 5 s."""
    for _ in range(250):
        adapter.put(FRAME)
        time.sleep(0.02)
        if enough():
            return


def test_slcan_is_opened_at_its_bit_rate_and_answers_corrected(node: list[str], adapter: SlcanAdapter) -> None:
    bus = ("--interface", "slcan", "--channel", adapter.path, "--bitrate", "250000")
    with running(*node, *bus) as log:
        fed(adapter, lambda: any(line.startswith(b"t200") for line in adapter.lines))
    assert any("running on slcan" in line for line in log)
    assert adapter.lines[:5] == [b"C", b"S5", b"", b"O", b"O"]  # python-can opens it twice
    assert adapter.lines[-1] == b"C"
    answers = adapter.lines[5:-1]
    assert answers
    for line in answers:
        assert line[:5] == b"t2008"
        values = ANSWER.decode_simple(bytes.fromhex(line[5:].decode()))
        assert values["Battery"] == pytest.approx(CORRECTED_A, abs=0.05 + 1e-9)
        assert values["Motor"] == pytest.approx(CORRECTED_A)


def test_slcan_that_only_listens_computes_and_never_sends(node: list[str], adapter: SlcanAdapter) -> None:
    bus = ("--interface", "slcan", "--channel", adapter.path, "--bitrate", "250000")
    with running(*node, *bus, "--listen-only") as log:
        rounds = iter(range(25))
        fed(adapter, lambda: next(rounds, None) is None)
    assert adapter.lines == [b"C", b"S5", b"", b"L", b"L", b"C"]
    assert any("listen-only: nothing is sent, and no frame acknowledged" in line for line in log)
    (counted,) = re.findall(r"ended: frames in (\d+), answers (\d+)", "".join(log))
    assert counted[0] == counted[1]
    assert int(counted[0]) > 20


class SerialLine:
    """A cable between two pseudo-terminals, with python-can's serial bus at the far end of it."""

    def __init__(self) -> None:
        self._pairs = [pty.openpty() for _ in range(2)]
        for _, terminal in self._pairs:
            tty.setraw(terminal)
        self.path, far = (os.ttyname(terminal) for _, terminal in self._pairs)
        (self._near, _), (self._far, _) = self._pairs
        self._ended = threading.Event()
        self._carrying = threading.Thread(target=self._carry)
        self._carrying.start()
        self.bus = can.Bus(far, "serial", ignore_config=True)

    def _carry(self) -> None:
        ends = {self._near: self._far, self._far: self._near}
        while not self._ended.is_set():
            for end in select.select(list(ends), [], [], 0.05)[0]:
                os.write(ends[end], os.read(end, 4096))

    def disturb(self, noise: bytes) -> None:
        """Let the node read bytes that nobody sent."""
        os.write(self._near, noise)

    def close(self) -> None:
        """Unplug it."""
        self.bus.shutdown()
        self._ended.set()
        self._carrying.join()
        for pair in self._pairs:
            for end in pair:
                os.close(end)


@pytest.fixture
def line() -> Iterator[SerialLine]:
    pytest.importorskip("serial", reason="python-can's serial needs pyserial")
    line = SerialLine()
    yield line
    line.close()


def answered(bus: can.BusABC) -> can.Message:
    """The first answer to frames of the sensors, one every 20 ms."""
    for _ in range(250):
        bus.send(can.Message(arbitration_id=0x100, data=MEASURED, is_extended_id=False))
        message = bus.recv(0.02)
        if message is not None and message.arbitration_id == 0x200:
            return message
    raise AssertionError("no answer came")


def test_serial_line_is_answered_corrected_also_after_a_disturbance(node: list[str], line: SerialLine) -> None:
    too_long, cut_off = b"\xaa\0\0\0\0\x09", b"\xaa\0\0"
    with running(*node, "--interface", "serial", "--channel", line.path) as log:
        for noise in (b"", b"\x55\x55", too_long, cut_off):
            line.disturb(noise)
            time.sleep(0.3)  # a driver that reads a frame that never ends gives up after 0.1 s
            values = ANSWER.decode_simple(bytes(answered(line.bus).data))
            assert values["Battery"] == pytest.approx(CORRECTED_A, abs=0.05 + 1e-9)
            while line.bus.recv(0.1) is not None:
                pass  # answers to the frames before
    assert any("running on serial" in text for text in log)
