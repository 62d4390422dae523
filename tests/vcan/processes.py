"""Processes on vcan0: the node, candump, canplayer, cansend."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

CHANNEL = "vcan0"
ECU_NODE = Path(sys.executable).parent / "ecu-node"
LONGEST_WAIT_S = 60.0
"""System calls of user-mode-linux are slow; nothing here takes this long unless it is broken. [s]"""


class LoggedFrame(NamedTuple):
    """One line of a candump log without its time."""

    identifier: str
    data: str


def frames_of(log: Path) -> list[LoggedFrame]:
    """Frames of a candump log in their order."""
    lines = [line.split() for line in log.read_text().splitlines()]
    return [LoggedFrame(*line[2].split("#", 1)) for line in lines]


def wait_until(done: Callable[[], bool], what: str) -> None:
    """Wait for something another process does."""
    give_up = time.monotonic() + LONGEST_WAIT_S
    while not done():
        assert time.monotonic() < give_up, f"waited in vain for {what}"
        time.sleep(0.02)


@dataclass(frozen=True, kw_only=True)
class NodeProcess:
    """``ecu-node run`` at work."""

    process: subprocess.Popen[bytes]
    log: Path

    def stop(self, how: signal.Signals = signal.SIGTERM) -> int:
        """End the node within a second and return its exit code."""
        self.process.send_signal(how)
        return self.process.wait(timeout=1.0)

    @property
    def messages(self) -> str:
        """What it said on standard error."""
        return self.log.read_text()


@contextmanager
def running_node(log: Path, *options: str) -> Iterator[NodeProcess]:
    """The node on vcan0, from when it says that it runs."""
    command = [str(ECU_NODE), "run", "--interface", "socketcan", "--channel", CHANNEL, *options]
    with log.open("wb") as file, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=file) as process:
        node = NodeProcess(process=process, log=log)
        try:
            wait_until(lambda: "running on" in node.messages or process.poll() is not None, "the node to start")
            assert process.poll() is None, node.messages
            yield node
        finally:
            process.kill()


@dataclass(frozen=True, kw_only=True)
class Recording:
    """candump at work."""

    log: Path

    @property
    def frames(self) -> list[LoggedFrame]:
        """Frames recorded so far."""
        whole_lines = self.log.read_text().rpartition("\n")[0].splitlines()
        return [LoggedFrame(*line.split()[2].split("#", 1)) for line in whole_lines]

    def data_of(self, identifier: int) -> list[bytes]:
        """Data of the frames of one identifier (11 bits) so far."""
        return [bytes.fromhex(frame.data) for frame in self.frames if frame.identifier == f"{identifier:03X}"]

    def wait_for(self, identifier: int, count: int) -> list[bytes]:
        """Wait until so many frames of an identifier are recorded; returns all of them."""
        wait_until(lambda: len(self.data_of(identifier)) >= count, f"{count} frames of {identifier:#x}")
        return self.data_of(identifier)


@contextmanager
def running_recording(log: Path) -> Iterator[Recording]:
    """Record vcan0 with candump, from when it listens."""
    before = _listeners()
    with log.open("wb") as file, subprocess.Popen(["candump", "-L", CHANNEL], stdout=file) as process:
        try:
            wait_until(lambda: _listeners() > before, "candump to listen")
            yield Recording(log=log)
        finally:
            process.terminate()


def play(log: Path) -> None:
    """Play a log of can0 on vcan0 with canplayer, in its own timing."""
    subprocess.run(["canplayer", "-I", str(log), f"{CHANNEL}=can0"], check=True, timeout=LONGEST_WAIT_S)


def send(frame: str) -> None:
    """Send one frame with cansend, such as 123#00FF."""
    subprocess.run(["cansend", CHANNEL, frame], check=True, timeout=LONGEST_WAIT_S)


def _listeners() -> int:
    """Sockets that receive every frame of vcan0."""
    lines = Path("/proc/net/can/rcvlist_all").read_text().splitlines()
    return sum(line.split()[0] == CHANNEL for line in lines if line.split())
