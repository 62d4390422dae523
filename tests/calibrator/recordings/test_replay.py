"""Playing logs onto a bus: order, timing, a bus that takes no frame, and Ctrl-C."""

import time
from pathlib import Path

import can
import pytest
from can.interfaces.virtual import VirtualBus

from calibrator.cli import app
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
    with can.Logger(tmp_path / "drive.log") as logger:
        for frame in FRAMES:
            logger(frame)
    return tmp_path / "drive.log"


def heard(bus: can.BusABC) -> list[tuple[int, bool, bytes]]:
    found = []
    while (message := bus.recv(0.0)) is not None:
        found.append((message.arbitration_id, message.is_extended_id, bytes(message.data)))
    return found


SENT = [(frame.arbitration_id, frame.is_extended_id, bytes(frame.data)) for frame in FRAMES]


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_frames_are_never_sent_before_their_time(speed: float) -> None:
    class Clocked(VirtualBus):
        times: list[float]

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            self.times.append(time.monotonic())

    with Clocked("clocked") as bus:
        bus.times = []
        begin = time.monotonic()
        list(play_frames(FRAMES, bus, speed=speed))
        for frame, instant in zip(FRAMES, bus.times, strict=True):
            assert instant - begin >= (frame.timestamp - FRAMES[0].timestamp) / speed


def test_backward_time_step_in_a_log_causes_no_waiting() -> None:
    frames = [can.Message(timestamp=stamp, arbitration_id=1) for stamp in (1e6, 1.0, 2.0)]
    with VirtualBus("one") as bus, VirtualBus("one") as listener:
        assert list(play_frames(frames, bus)) == [0.0, 1.0 - 1e6, 2.0 - 1e6]
        assert len(heard(listener)) == 3


def test_bus_that_accepts_no_frame_ends_the_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(VirtualBus):
        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("Transmit buffer full")

    monkeypatch.setattr("calibrator.recordings.live._SEND_LIMIT_S", 0.01)
    with Full("full") as bus:
        with pytest.raises(BusError, match=r"the bus takes no frame: Transmit buffer full$"):
            list(play_frames(FRAMES, bus, speed=0.0))
        with pytest.raises(BusError, match=r"Transmit buffer full; a CAN FD frame needs --fd$"):
            list(play_frames([can.Message(is_fd=True)], bus))


def command(*arguments: object) -> int:
    """Exit code of the command, in this process."""
    return run_app(app, "calibrator", ["replay", *map(str, arguments)])


def test_replay_command_sends_a_log_and_counts_frames(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with VirtualBus("command") as bus:
        assert command(log, "--interface", "virtual", "--channel", "command", "--speed", "0") == 0
        assert heard(bus) == SENT
    assert capsys.readouterr().out.startswith("60 frames in ")


def test_ctrl_c_reports_progress(
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
