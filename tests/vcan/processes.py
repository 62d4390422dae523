"""Processes on vcan0 and vcan1: the node, candump, canplayer, cansend, cangen, ip, tc."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

CHANNEL, OTHER_CHANNEL = "vcan0", "vcan1"
ECU_NODE = (sys.executable, "-m", "ecu_node")
LONGEST_WAIT_S = 180.0
"""System calls of user-mode-linux are slow; nothing here takes this long unless it is broken. [s]"""


class LoggedFrame(NamedTuple):
    """One line of a candump log without its time."""

    identifier: str
    data: str


def run_tool(*command: str) -> None:
    """Run a program that must succeed."""
    subprocess.run(command, check=True, timeout=LONGEST_WAIT_S)


def bring_up(channel: str) -> None:
    """Bring an interface up as tools/with_vcan does."""
    for words in (("mtu", "72"), ("txqueuelen", "1000"), ("up",)):
        run_tool("ip", "link", "set", channel, *words)


def frames_of(log: Path) -> list[LoggedFrame]:
    """Frames of a candump log in their order."""
    whole_lines = log.read_text().rpartition("\n")[0].splitlines()  # of one that is being written
    return [LoggedFrame(*line.split()[2].split("#", 1)) for line in whole_lines]


def data_of(frames: Iterable[LoggedFrame], identifier: int) -> list[bytes]:
    """Data of the frames of one identifier (11 bits)."""
    return [bytes.fromhex(frame.data) for frame in frames if frame.identifier == f"{identifier:03X}"]


def wait_until(done: Callable[[], bool], what: str) -> None:
    """Wait for something another process does."""
    give_up = time.monotonic() + LONGEST_WAIT_S
    while not done():
        assert time.monotonic() < give_up, f"waited in vain for {what}"
        time.sleep(0.05)


@dataclass(frozen=True, kw_only=True)
class NodeProcess:
    """``ecu-node run`` at work."""

    process: subprocess.Popen[bytes]
    log: Path

    def wait_for(self, words: str) -> None:
        """Wait until it has said this."""
        wait_until(lambda: words in self.messages or self.process.poll() is not None, f"the node to say {words!r}")
        assert words in self.messages, self.messages

    def stop(self, how: signal.Signals = signal.SIGTERM, *, within_s: float = LONGEST_WAIT_S) -> int:
        """End the node and return its exit code; one whose coverage is traced takes as long as it likes."""
        self.process.send_signal(how)
        return self.process.wait(timeout=within_s if sys.gettrace() is None else LONGEST_WAIT_S)

    @property
    def messages(self) -> str:
        """What it said on standard error."""
        return self.log.read_text()


@contextmanager
def running_node(log: Path, *options: str, by: Sequence[str] = ()) -> Iterator[NodeProcess]:
    """The node on vcan0, started by another program if one is given, from when it says that it runs."""
    command = [*by, *ECU_NODE, "run", "--interface", "socketcan", "--channel", CHANNEL, *options]
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
        return frames_of(self.log)

    def data_of(self, identifier: int) -> list[bytes]:
        """Data of the frames of one identifier (11 bits) so far."""
        return data_of(self.frames, identifier)

    def wait_for_marker(self, identifier: int) -> None:
        """Send a frame on vcan0 that nobody else sends, and wait until it is recorded: what was before it is, too."""
        send(f"{identifier:03X}#")
        self.wait_for(identifier, 1)

    def wait_for(self, identifier: int, count: int) -> list[bytes]:
        """Wait until so many frames of an identifier are recorded; returns all of them."""
        wait_until(lambda: len(self.data_of(identifier)) >= count, f"{count} frames of {identifier:#x}")
        return self.data_of(identifier)


@contextmanager
def running_recording(log: Path, channel: str = CHANNEL) -> Iterator[Recording]:
    """Record a bus with candump, from when it listens; it goes on when the bus goes down and up."""
    before = _listeners(channel)
    command = ["candump", "-L", "-D", channel]
    with log.open("wb") as file, subprocess.Popen(command, stdout=file, stderr=subprocess.DEVNULL) as process:
        try:
            wait_until(lambda: _listeners(channel) > before, "candump to listen")
            yield Recording(log=log)
        finally:
            process.terminate()


def play(log: Path) -> None:
    """Play a log of can0 on vcan0 with canplayer, in its own timing."""
    run_tool("canplayer", "-I", str(log), f"{CHANNEL}=can0")


@contextmanager
def playing(log: Path, *, endlessly: bool = False) -> Iterator[subprocess.Popen[bytes]]:
    """Within the block, play a log of can0 on vcan0, once or again and again."""
    command = ["canplayer", "-I", str(log), *["-l", "i"] * endlessly, f"{CHANNEL}=can0"]
    with subprocess.Popen(command) as process:
        try:
            yield process
        finally:
            process.terminate()


def generate(channel: str, count: int, *options: str) -> None:
    """Send so many frames with cangen, no faster than a slow kernel hands them on; random data unless given."""
    run_tool("cangen", channel, "-n", str(count), "-g", "8", *options)


def send(frame: str, channel: str = CHANNEL) -> None:
    """Send one frame with cansend, such as 123#00FF."""
    run_tool("cansend", channel, frame)


def _listeners(channel: str) -> int:
    """Sockets that receive every frame of a bus."""
    lines = Path("/proc/net/can/rcvlist_all").read_text().splitlines()
    return sum(line.split()[0] == channel for line in lines if line.split())
