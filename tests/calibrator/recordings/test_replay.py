"""Playing logs onto a bus: formats, order, timing, and logs that cannot be played."""

import gzip
import json
import re
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest
from can.interfaces.virtual import VirtualBus

from calibrator.cli import app
from calibrator.recordings.frames import LOG_SUFFIXES, read_frames
from calibrator.recordings.live import play_frames
from calibrator.terminal.command_line import run_app
from ecu_node.errors import BusError

FRAMES = [
    can.Message(
        timestamp=1000.0 + 0.001 * k,
        arbitration_id=0x18FF0000 + k if k % 5 == 0 else 0x100 + k,
        is_extended_id=k % 5 == 0,
        data=bytes([k] * (k % 9)),
        is_rx=False,
    )
    for k in range(60)
]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return written(tmp_path / "drive.log")


def written(path: Path) -> Path:
    with can.Logger(path) as logger:
        for frame in FRAMES:
            logger(frame)
    return path


@pytest.fixture
def listener(request: pytest.FixtureRequest) -> Iterator[can.BusABC]:
    with VirtualBus(request.node.name) as bus:
        yield bus


def heard(bus: can.BusABC) -> list[tuple[int, bool, bytes]]:
    found = []
    while (message := bus.recv(0.0)) is not None:
        found.append((message.arbitration_id, message.is_extended_id, bytes(message.data)))
    return found


SENT = [(frame.arbitration_id, frame.is_extended_id, bytes(frame.data)) for frame in FRAMES]


@pytest.mark.parametrize("name", ["x.log", "x.asc", "x.blf", "x.trc", "x.mf4", "x.log.gz", "x.asc.gz", "X.BLF"])
def test_every_frame_of_every_format_comes_in_order(
    tmp_path: Path, listener: can.BusABC, name: str, request: pytest.FixtureRequest
) -> None:
    path = written(tmp_path / name)
    with VirtualBus(request.node.name) as bus:
        assert play_frames(read_frames(path).messages(), bus, speed=0.0) == len(FRAMES)
    assert heard(listener) == SENT


def test_a_zipped_blf_is_played(tmp_path: Path) -> None:
    path = tmp_path / "x.blf.gz"
    path.write_bytes(gzip.compress(written(tmp_path / "x.blf").read_bytes()))
    assert len(list(read_frames(path).messages())) == len(FRAMES)


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_frames_never_come_before_their_instant(speed: float) -> None:
    class Clocked(VirtualBus):
        times: list[float]

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            self.times.append(time.monotonic())

    with Clocked("clocked") as bus:
        bus.times = []
        begin = time.monotonic()
        play_frames(FRAMES, bus, speed=speed)
        for frame, instant in zip(FRAMES, bus.times, strict=True):
            assert instant - begin >= (frame.timestamp - FRAMES[0].timestamp) / speed


def test_a_log_that_goes_back_in_time_is_not_waited_for(listener: can.BusABC, request: pytest.FixtureRequest) -> None:
    frames = [can.Message(timestamp=stamp, arbitration_id=1) for stamp in (1e6, 1.0, 2.0)]
    with VirtualBus(request.node.name) as bus:
        assert play_frames(frames, bus) == 3


def test_error_frames_are_left_out(listener: can.BusABC, request: pytest.FixtureRequest) -> None:
    frames = [can.Message(is_error_frame=True), can.Message(arbitration_id=1)]
    with VirtualBus(request.node.name) as bus:
        assert play_frames(frames, bus, speed=0.0) == 1
    assert len(heard(listener)) == 1


def test_a_bus_that_takes_nothing_ends_the_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(VirtualBus):
        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("Transmit buffer full")

    monkeypatch.setattr("calibrator.recordings.live._SEND_LIMIT_S", 0.01)
    with Full("full") as bus, pytest.raises(BusError, match="the bus takes no frame: Transmit buffer full"):
        play_frames(FRAMES, bus, speed=0.0)


def cut(path: Path, size: int) -> Path:
    path.write_bytes(path.read_bytes()[:size])
    return path


def looping_blf(path: Path) -> Path:
    """A BLF whose object has size 0: python-can's reader goes round for ever."""
    inner = zlib.compress(struct.pack("<4sHHLL", b"LOBJ", 16, 1, 0, 99) + bytes(64))
    body = struct.pack("<4sHHLLHxxxxxxLxxxx", b"LOBJ", 16, 1, 32 + len(inner), 10, 2, 80) + inner
    head = written(path).read_bytes()[:144]
    path.write_bytes(head + body + bytes(len(body) % 4))
    return path


def test_logs_that_cannot_be_played_are_named_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cases: dict[str, tuple[Callable[[Path], object], str]] = {
        "missing.log": (lambda path: path, "no such file"),
        "folder.log": (Path.mkdir, r"a folder; give one log file \(\.log"),
        "x.xyz": (written_text, r"not a known log format; expected \.log"),
        "x.csv": (lambda path: path.write_text("time,current\n0,1\n1,2\n"), "a table of values, not a log"),
        "empty.log": (lambda path: path.write_bytes(b""), "the log is empty"),
        "torn.log": (written_text, "line 1 is damaged"),
        "binary.asc": (lambda path: path.write_bytes(b"\xff\xfe\x00" * 50), "binary.asc: "),
        "empty.blf": (lambda path: path.write_bytes(b""), "truncated or damaged BLF"),
        "cut.blf": (lambda path: cut(written(path), 200), "truncated or damaged BLF"),
        "loop.blf": (looping_blf, "object of 0 bytes"),
        "damaged.mf4": (lambda path: cut(written(path), 500), "not a readable MF4 file"),
        "notzip.log.gz": (written_text, "truncated or damaged in its first line: Not a gzipped file"),
        "cut.log.gz": (lambda path: cut(written(path), 150), "truncated or damaged after line"),
    }
    for name, (make, words) in cases.items():
        make(tmp_path / name)
        assert command(tmp_path / name, "--channel", "none", "--interface", "virtual") == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert re.search(words, line), line
        assert name in line


def written_text(path: Path) -> None:
    path.write_text("(1.0) can0 this is no frame\n")


def command(*arguments: object) -> int:
    """Exit code of the command, in this process."""
    return run_app(app, "calibrator", ["replay", *map(str, arguments)])


def test_the_command_plays_a_log_and_counts(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with VirtualBus("command") as bus:
        assert command(log, "--interface", "virtual", "--channel", "command", "--speed", "0") == 0
        assert heard(bus) == SENT
    assert capsys.readouterr().out.startswith("60 frames in ")


@pytest.mark.parametrize(
    ("name", "interface", "words"),
    [
        ("missing.log", "virtual", "calibrator: .*no such file"),
        ("drive.log", "pigeon", "calibrator: pigeon c: cannot open"),
    ],
)
def test_a_replay_that_fails_ends_in_1(
    log: Path, capsys: pytest.CaptureFixture[str], name: str, interface: str, words: str
) -> None:
    assert command(log.parent / name, "--interface", interface, "--channel", "c") == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert re.match(words, captured.err)


def test_ctrl_c_ends_the_line_of_progress_first_and_says_how_much_was_sent(
    log: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def send(self: VirtualBus, msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id == FRAMES[3].arbitration_id:
            raise KeyboardInterrupt

    monkeypatch.setattr(VirtualBus, "send", send)
    monkeypatch.setattr("calibrator.terminal.progress.LINE_EVERY_S", 0.0)
    assert command(log, "--interface", "virtual", "--channel", "c") == 130
    *_, progress, last = capsys.readouterr().err.splitlines()
    assert progress.startswith(f"replay: 3 of {len(FRAMES)} frames, ")
    assert last == f"calibrator replay: 3 of {len(FRAMES)} frames were sent"


def test_the_account_as_json_is_all_that_stands_on_standard_output(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with VirtualBus("json"):
        assert command(log, "--interface", "virtual", "--channel", "json", "--speed", "0", "--json") == 0
    account = json.loads(capsys.readouterr().out)
    assert account.keys() == {"frames", "duration_s"}
    assert account["frames"] == 60


def test_long_payloads_are_played_as_can_fd(tmp_path: Path) -> None:
    path = tmp_path / "fd.log"
    path.write_text("(1.000000) can0 123##1" + "AB" * 12 + "\n(1.100000) can0 123#AB\n")
    frames = list(read_frames(path).messages())
    assert [(frame.is_fd, bytes(frame.data)) for frame in frames] == [(True, b"\xab" * 12), (False, b"\xab")]


def test_help_names_the_formats_that_are_read(capsys: pytest.CaptureFixture[str]) -> None:
    assert command("--help") == 0
    assert " ".join(LOG_SUFFIXES) in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("more", [[], ["--channel"]])
def test_wrong_use_of_replay_ends_in_2(log: Path, more: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert command(log, *more) == 2
    assert "--channel" in capsys.readouterr().err


@pytest.mark.parametrize("speed", ["-1", "nan", "inf", "fast"])
def test_speed_that_is_none_is_named_with_what_is_expected(
    log: Path, speed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(log, "--channel=c", f"--speed={speed}") == 2
    assert f"'--speed': {speed}: expected a number from 0 to 1" in capsys.readouterr().err
