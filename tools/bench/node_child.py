"""A real ``ecu-node run`` on the virtual bus, in a process with a thread that sends to it and watches it.

Started by :mod:`bench.node` with its arguments as JSON; prints what it saw as JSON. What stands beside the node
here is one thread, one bus with its queue, and a few frames; the node's memory is read before they are there, and when
they are. Imports nothing that the node itself does not.
"""

import json
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any, TypedDict

__all__ = ["Seen", "main"]

_BLOCK = 100
"""Frames that are sent before it is waited for them."""
_PATIENCE_S = 5.0


class Seen(TypedDict):
    """What was seen of one node; memory is resident."""

    start_s: float
    """From when the process was created to the first corrected frame."""
    ready_s: float
    """From then to when the node says that it is ready."""
    ready_bytes: int
    """Memory of the node, before anything stands beside it."""
    extras_bytes: int
    """What it grew by when the frames and the bus beside it were there, and the first frame was corrected."""
    end_bytes: int
    """Memory at the end, extras included."""
    peak_bytes: int
    """Most memory ever, extras included."""
    frames: int
    wrong: int
    cpu_s: float
    """Processor time of the node's own thread over all frames."""
    modules: list[str]
    """Large modules that should not be there."""


def main() -> None:
    """Run the node until the thread beside it has seen enough."""
    job: dict[str, Any] = json.loads(sys.argv[1])
    address = f"\0bench-node-{os.getpid()}"
    ready = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    ready.bind(address)
    os.environ["NOTIFY_SOCKET"] = "@" + address[1:]
    seen: list[Seen] = []
    threading.Thread(target=_watch, args=(job, ready, seen), daemon=True).start()
    from ecu_node.cli import main as ecu_node  # noqa: PLC0415  # its start is measured

    code = ecu_node(job["arguments"])
    print(json.dumps(seen[0] if seen else {"code": code}))


def _watch(job: dict[str, Any], ready: socket.socket, seen: list[Seen]) -> None:
    """Wait for the node as a service manager does, send to it, receive from it, and end it."""
    try:
        while not ready.recv(4096).startswith(b"READY=1"):
            pass
        threading.Thread(target=_drain, args=(ready,), daemon=True).start()
        seen.append(_seen(job))
    finally:
        os.kill(os.getpid(), signal.SIGTERM)


def _drain(ready: socket.socket) -> None:
    while ready.recv(4096):
        pass


def _seen(job: dict[str, Any]) -> Seen:
    ready_s, ready_bytes = time.monotonic() - job["created_s"], _memory("VmRSS")
    import can  # noqa: PLC0415  # as the node has imported it

    identifier: int = job["identifier"]
    frames = [bytes.fromhex(text) for text in job["frames"]]
    expected = [bytes.fromhex(text) for text in job["expected"]]
    messages = [can.Message(arbitration_id=identifier, is_extended_id=False, data=frame) for frame in frames]
    received = wrong = 0
    with (
        can.Bus(job["channels"][0], "virtual", ignore_config=True) as sending,
        can.Bus(job["channels"][1], "virtual", ignore_config=True) as receiving,
    ):

        def take() -> None:
            nonlocal received, wrong
            message = receiving.recv(_PATIENCE_S)
            if message is None:
                raise TimeoutError(f"frame {received} never came")
            if message.arbitration_id == identifier:
                wrong += message.data != expected[received % len(expected)]
                received += 1

        sending.send(messages[0])
        while not received:
            take()
        start_s, extras_bytes = time.monotonic() - job["created_s"], _memory("VmRSS") - ready_bytes
        clock = time.pthread_getcpuclockid(threading.main_thread().ident or 0)
        cpu_s = time.clock_gettime(clock)
        sent = 1
        while sent < job["count"]:
            block = min(_BLOCK, job["count"] - sent)
            for k in range(sent, sent + block):
                sending.send(messages[k % len(messages)])
            sent += block
            while received < sent:
                take()
        cpu_s = time.clock_gettime(clock) - cpu_s
        return Seen(
            start_s=start_s,
            ready_s=ready_s,
            ready_bytes=ready_bytes,
            extras_bytes=extras_bytes,
            end_bytes=_memory("VmRSS"),
            peak_bytes=_memory("VmHWM"),
            frames=received,
            wrong=wrong,
            cpu_s=cpu_s,
            modules=[name for name in ("numpy", "pandas", "asammdf", "cvxpy", "matplotlib") if name in sys.modules],
        )


def _memory(what: str) -> int:
    """A line of /proc/self/status. [byte]"""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(what)).split()[1])


if __name__ == "__main__":
    main()
