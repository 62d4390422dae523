"""Commands of the node in this process; the node in a process of its own; the service manager that it reports to."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import pytest

from ecu_node.cli import run_ecu_node
from tests.ecu_node.vehicles import LAYOUT

LONGEST_WAIT_S = 60.0
"""A busy machine is slow; nothing here takes this long unless it is broken. [s]"""


class Done(NamedTuple):
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


def ecu_node(*words: object) -> Done:
    """Run a command of the node in this process."""
    arguments = [os.fsdecode(word) if isinstance(word, bytes) else str(word) for word in words]
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        try:
            code = run_ecu_node(arguments)
        except SystemExit as end:
            code = int(end.code or 0)
    return Done(code, out.getvalue(), err.getvalue())


def wait_until(done: Callable[[], bool]) -> None:
    give_up = time.monotonic() + LONGEST_WAIT_S
    while not done():
        assert time.monotonic() < give_up, "waited in vain"
        time.sleep(0.002)


def bench_node(folder: Path, channel: str) -> list[str]:
    """Command line of a node without parameters on a virtual bus."""
    options = {"--params": folder / "none.json", "--layout": LAYOUT, "--vehicle": "V1", "--channel": channel}
    return ["run", "--unsigned", "--interface", "virtual", *(str(word) for item in options.items() for word in item)]


@contextmanager
def running(
    *options: str, program: Sequence[str] = ("-m", "ecu_node"), until: str = "running on"
) -> Iterator[list[str]]:
    """A node in a process of its own, once it reports that it runs; the lines of its log, complete after the block."""
    command = [sys.executable, *program, *options]
    environment = {**os.environ, "CAN_CONFIG": os.environ.get("CAN_CONFIG", '{"sleep_after_open": 0}')}
    log: list[str] = []
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stderr is not None
        try:
            for line in process.stderr:
                log.append(line)
                if until in line:
                    break
            yield log
        finally:
            process.send_signal(signal.SIGTERM)
            log += process.stderr.readlines()
            assert process.wait(timeout=30) == 0, log


class ServiceManagerHere:
    """A datagram socket in the place of systemd's."""

    def __init__(self, address: Path, patch: pytest.MonkeyPatch) -> None:
        patch.setenv("NOTIFY_SOCKET", str(address))
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(address))
        self.socket.settimeout(LONGEST_WAIT_S)

    def wait_for(self, words: str) -> str:
        """The first message from now on with these words."""
        while words not in (message := self.socket.recv(4096).decode()):
            pass
        return message

    def told(self) -> list[str]:
        """All messages received so far."""
        texts = []
        self.socket.settimeout(0.0)
        with suppress(BlockingIOError):
            while True:
                texts.append(self.socket.recv(4096).decode())
        return texts
