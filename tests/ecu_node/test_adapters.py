"""How an adapter is opened: its speed, python-can's configuration, a dry run, and a node that only listens.

An slcan adapter is a pseudo-terminal whose other end speaks the protocol; networks are those of python-can.
"""

import json
import os
import pty
import re
import select
import struct
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from can.typechecking import BitTimingFdDict

from ecu_node.bus.adapters import bus_config, carries_fd, connect
from ecu_node.errors import BusError
from ecu_node.parameters import write_parameters
from tests.ecu_node.processes import ServiceManagerHere, ecu_node, running
from tests.ecu_node.vehicles import SMALL_DBC, MakeDatabase, parameters_for

_FD_VALUES = (80_000_000, 2, 63, 16, 16, 2, 15, 4, 4)
FD_TIMING: dict[str, Any] = dict(zip(BitTimingFdDict.__annotations__, _FD_VALUES, strict=True))
"""500 kbit/s and 2 Mbit/s, both sampled at 80 %."""
FD_RATES = {"fd": True, "bitrate": 500_000, "data_bitrate": 2_000_000}
CLASSIC_TIMING: dict[str, Any] = {"f_clock": 8_000_000, "brp": 2, "tseg1": 13, "tseg2": 2, "sjw": 1, "nof_samples": 1}
"""250 kbit/s, sampled at 87.5 %."""
DATABASE = cantools.database.can.Database()
DATABASE.add_dbc_string(SMALL_DBC)
PAIR, ANSWER = DATABASE.get_message_by_name("Pair"), DATABASE.get_message_by_name("PairOut")
BATTERY_A, CORRECTED_A = 111.0, 100.0
"""Measured and corrected current of a battery whose sensor has a gain error of +0.1 and an offset of 1 A. [A]"""


@pytest.fixture(autouse=True)
def _no_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ignore the configuration of the user who runs the tests; HOME holds can.conf."""
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


RATES = [
    ("pcan kvaser vector slcan gs_usb ixxat cantact", {}, {}, "no bitrate: .* into section .* --bitrate BIT_PER_S"),
    ("kvaser vector ixxat", {}, {"fd": True, "bitrate": 500_000}, "no data_bitrate: .* --data-bitrate BIT_PER_S"),
    ("pcan slcan nixnet", {}, FD_RATES, r"CAN FD needs its bit timing: f_clock, .* in section \[1\] of can.conf"),
    ("socketcan virtual udp_multicast serial", {}, {"bitrate": 250_000}, "the bit rate of .* is not set from here"),
    ("pcan", {"bitrate": "250k"}, {}, "bitrate = 250k: a number of bit/s is expected"),
    ("pcan", {"bitrate": -1}, {}, "bitrate = -1: a number of bit/s is expected"),
    ("pcan", {"bitrate": 83_300}, {}, "bitrate = 83300: pcan has 1000000, .*; or give the bit timing"),
    ("pcan", {"f_clock": 8_000_000, "bitrate": 250_000}, {}, "incomplete, .* classic CAN .* brp, tseg1"),
    ("pcan", FD_TIMING, {}, "not one of classic CAN"),
    ("pcan", CLASSIC_TIMING, {"fd": True}, "not one of CAN FD, which has f_clock, nom_brp"),
    ("pcan", {**CLASSIC_TIMING, "bitrate": 500_000}, {}, "500000 contradicts the bit timing .BR: 250_000"),
    ("pcan", {**FD_TIMING, "data_bitrate": 4_000_000}, {"fd": True}, "data_bitrate = 4000000 contradicts"),
    ("ixxat", CLASSIC_TIMING, {}, "python-can cannot set a bit timing there; take f_clock out"),
    ("virtual", [1], {}, 'CAN_CONFIG is no JSON object, such as {"bitrate": 500000}; see --interface, CAN_CONFIG'),
    ("virtual", None, {}, "CAN_CONFIG is no JSON object"),
]


@pytest.mark.parametrize(("interfaces", "config", "settings", "words"), RATES)
def test_missing_or_contradictory_settings_are_refused(
    interfaces: str, config: object, settings: Any, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAN_CONFIG", json.dumps(config))
    for interface in interfaces.split():
        with pytest.raises(BusError, match=f"^{interface} 1: .*{words}"):
            connect(interface, "1", **settings)


@pytest.mark.parametrize("interface", ["kvaser", "neovi", "pcan"])
def test_adapter_without_its_driver_is_refused_with_advice_to_install_it(interface: str) -> None:
    """python-can calls functions of a driver that it did not find."""
    with pytest.raises(BusError, match=f"^{interface} 0: cannot open the bus: .*; install the driver of the adapter"):
        connect(interface, "0", bitrate=500_000)


# ---- python-can's configuration


def test_bit_rate_of_command_line_overrides_that_of_can_conf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "can.conf").write_text("[default]\nbitrate = 125000\n[1]\nbitrate = 250000\nserial = 1234\n")
    assert bus_config("vector", "1") == {"interface": "vector", "channel": 1, "bitrate": 250_000, "serial": 1234}
    assert bus_config("vector", "2")["bitrate"] == 125_000
    rates = bus_config("kvaser", "1", fd=True, bitrate=500_000, data_bitrate=2_000_000)
    assert (rates["fd"], rates["bitrate"], rates["data_bitrate"]) == (True, 500_000, 2_000_000)
    assert bus_config("vector", "1", bitrate=500_000, data_bitrate=None)["bitrate"] == 500_000
    monkeypatch.setenv("CAN_BITRATE", "100000")
    assert bus_config("vector", "1")["bitrate"] == 100_000


CARRIES_FD = [("socketcan", "lo", True), ("socketcan", "none", False), ("virtual", "lo", False)]


@pytest.mark.parametrize(("interface", "channel", "fd"), CARRIES_FD)
def test_can_fd_support_of_an_interface_is_read_from_its_mtu(interface: str, channel: str, fd: bool) -> None:
    assert carries_fd(interface, channel) == fd


# ---- a dry run


PCAN = ("--interface", "pcan", "--channel", "PCAN_USBBUS1")
"""An adapter whose library is not installed here: opening it would fail."""


DryRun = Callable[..., list[str]]


@pytest.fixture
def dry_run(node: list[str]) -> DryRun:
    """Lines that the node with these options prints of what it would do."""

    def run(*options: str) -> list[str]:
        done = ecu_node(*node, *options, "--dry-run")
        assert (done.code, done.err) == (0, "")
        return done.out.splitlines()

    return run


def test_dry_run_prints_the_bus_that_would_be_opened(node: list[str], dry_run: DryRun) -> None:
    rate = ("--bitrate", "250000")
    reads, sends = "  reads Pair (0x100), Heater (0x200), Net (0x102)", "  sends PairOut (0x200)"
    assert dry_run(*PCAN, *rate) == ["would open pcan PCAN_USBBUS1: bitrate 250000", reads, sends]
    foreign = f"{node[node.index('--params') + 1]}: parameters are for vehicle 'v1', this is 'v2'"
    for option, value, why in (("--params", "none.json", "none.json: no such parameter"), ("--vehicle", "v2", foreign)):
        assert dry_run(*PCAN, *rate, option, value)[-1].startswith(f"would correct nothing: {why}")
    done = ecu_node(*node, *PCAN, "--dry-run")
    assert done.code == 1
    assert "no bitrate" in done.err


@pytest.mark.parametrize(
    "timing", [can.BitTiming(**CLASSIC_TIMING), can.BitTimingFd(**FD_TIMING)], ids=["classic", "FD"]
)
def test_bit_timing_is_printed_once(timing: can.BitTiming | can.BitTimingFd, tmp_path: Path, dry_run: DryRun) -> None:
    lines = [f"{name} = {value}" for name, value in timing.items()]
    (tmp_path / "can.conf").write_text("\n".join(["[PCAN_USBBUS1]", *lines]))
    opened = dry_run(*PCAN, *(("--fd",) if isinstance(timing, can.BitTimingFd) else ()))[0]
    assert opened.startswith("would open pcan PCAN_USBBUS1: ")
    assert f"timing {timing}" in opened
    assert "f_clock" not in opened


def test_dry_run_of_a_gateway_prints_both_directions(dry_run: DryRun) -> None:
    assert dry_run("--interface", "virtual", "--channel", "a", "--gateway", "b") == [
        "would open virtual a: no settings",
        "  reads all frames; corrects Pair (0x100), Heater (0x200)",
        "  sends all other frames of the other bus, as they are",
        "would open virtual b: no settings",
        "  reads all frames",
        "  sends Pair (0x100), Heater (0x200), corrected; nothing; all other frames of the other bus, as they are",
    ]


# ---- listening only


ACKNOWLEDGED = [
    ("slcan", "nothing is sent, and no frame acknowledged"),
    ("gs_usb", "the adapter acknowledges frames, as python-can has no listen-only mode of gs_usb"),
    ("socketcan", r"acknowledges frames, unless .*'ip link set c0 type can listen-only on'"),
    ("virtual", "nothing is sent$"),
]


@pytest.mark.parametrize(("interface", "words"), ACKNOWLEDGED)
def test_dry_run_says_whether_frames_are_acknowledged(interface: str, words: str, dry_run: DryRun) -> None:
    rate = ["--bitrate", "250000"] if interface in {"slcan", "gs_usb"} else []
    *_, sends, last = dry_run("--interface", interface, "--channel", "c0", *rate, "--listen-only")
    assert sends == "  sends nothing"
    assert re.search(words, last)


class SerialLine:
    """The far end of a serial line, to which the node's adapter is connected; `taken` is all that the node has sent."""

    def __init__(self) -> None:
        self._here, self._there = pty.openpty()
        tty.setraw(self._there)
        self.path, self.taken = os.ttyname(self._there), b""

    def put(self, data: bytes) -> None:
        os.write(self._here, data)

    def take(self, within_s: float) -> None:
        """Take what the node sends, until nothing more comes for this long."""
        while select.select([self._here], [], [], within_s)[0]:
            self.taken += os.read(self._here, 4096)

    def close(self) -> None:
        for end in (self._here, self._there):
            os.close(end)


@pytest.fixture
def line() -> Iterator[SerialLine]:
    pytest.importorskip("serial", reason="python-can's drivers of serial lines need pyserial")
    line = SerialLine()
    yield line
    line.close()


MEASURED = PAIR.encode({"Battery": BATTERY_A, "Motor": CORRECTED_A})
SLCAN_FRAME = b"t1008" + MEASURED.hex().upper().encode() + b"\r"
RIGHT = {"Battery": pytest.approx(CORRECTED_A, abs=0.05 + 1e-9), "Motor": pytest.approx(CORRECTED_A)}


def answer(data: bytes) -> dict[str, Any]:
    """Currents of an answer of the node. [A]"""
    return {name: value for name, value in ANSWER.decode_simple(data).items() if name in RIGHT}


@pytest.mark.parametrize(("options", "opened"), [((), b"O"), (("--listen-only",), b"L")])
def test_node_on_slcan_adapter_sends_corrected_currents_unless_listen_only(
    node: list[str], line: SerialLine, options: tuple[str, ...], opened: bytes
) -> None:
    bus = ("--interface", "slcan", "--channel", line.path, "--bitrate", "250000")
    with running(*node, *bus, *options) as log:
        for _ in range(10):
            line.put(SLCAN_FRAME)
            line.take(0.02)
    line.take(0.1)
    head, answers, last = line.taken.split(b"\r")[:5], line.taken.split(b"\r")[5:-2], line.taken[-2:]
    assert (head, last) == ([b"C", b"S5", b"", opened, opened], b"C\r")  # python-can opens it twice
    (counted,) = re.findall(r"ended: frames in (\d+), answers (\d+)", "".join(log))
    assert counted[0] == counted[1]
    assert int(counted[0]) > 5
    assert len(answers) == (0 if options else int(counted[0]))
    assert {text[:5] for text in answers} <= {b"t2008"}
    assert all(answer(bytes.fromhex(text[5:].decode())) == RIGHT for text in answers)
    assert any("listen-only: nothing is sent, and no frame acknowledged" in text for text in log) == bool(options)


def test_unpublished_branch_and_silence_of_all_branches_are_logged(
    node: list[str], line: SerialLine, make_database: MakeDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service manager is told of the silence, too."""
    manager = ServiceManagerHere(tmp_path / "notify", monkeypatch)
    write_parameters(parameters_for(make_database(), battery=(0.1, 1.0), heater=(0.1, 0.0)), tmp_path / "v1.json")
    with manager.socket, running(*node, "--interface", "slcan", "--channel", line.path, "--bitrate", "250000") as log:
        line.put(SLCAN_FRAME)
        manager.wait_for("STATUS=no branch sends")
    assert any("branch heater is not published: the parameters apply a fault to it" in text for text in log)
    assert "ecu-node: no branch sends\n" in log


def test_node_on_serial_line_recovers_after_garbage_and_cut_off_frames(node: list[str], line: SerialLine) -> None:
    """A frame of python-can's serial bus is 0xAA, time, length, identifier, data and 0xBB."""
    too_long, cut_off = b"\xaa\0\0\0\0\x09", b"\xaa\0\0"
    with running(*node, "--interface", "serial", "--channel", line.path):
        for noise in (b"", b"\x55\x55", too_long, cut_off):
            line.put(noise)
            time.sleep(0.15)  # a driver that reads a frame that never ends gives up after 0.1 s
            line.taken = b""
            for _ in range(250):
                line.put(b"\xaa" + struct.pack("<IBI", 0, 8, 0x100) + MEASURED + b"\xbb")
                line.take(0.02)
                if len(line.taken) >= 19:
                    break
            assert line.taken[5:10] == struct.pack("<BI", 8, 0x200)
            assert answer(line.taken[10:18]) == RIGHT
            line.take(0.05)
