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
from typing import Any

_BLOCK = 100
"""Frames that are sent before it is waited for them."""
_PATIENCE_S = 5.0


def main() -> None:
    """Run the node until the thread beside it has seen enough."""
    job, seen = json.loads(sys.argv[1]), dict[str, float]()
    address = f"\0bench-node-{os.getpid()}"
    ready = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    ready.bind(address)
    os.environ["NOTIFY_SOCKET"] = "@" + address[1:]
    threading.Thread(target=_watch, args=(job, ready, seen), daemon=True).start()
    from ecu_node.cli import run_ecu_node as ecu_node  # noqa: PLC0415  # its start is measured

    seen["code"] = ecu_node(job["arguments"])
    print(json.dumps(seen))


def _watch(job: dict[str, Any], ready: socket.socket, seen: dict[str, float]) -> None:
    """Wait for the node as a service manager does, send to it, receive from it, and end it."""
    try:
        while not ready.recv(4096).startswith(b"READY=1"):
            pass
        threading.Thread(target=_drain, args=(ready,), daemon=True).start()
        _look(job, seen)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)


def _drain(ready: socket.socket) -> None:
    while ready.recv(4096):
        pass


def _look(job: dict[str, Any], seen: dict[str, float]) -> None:
    """Times since the process was created, resident memory, and frames that came."""
    seen |= {"ready_s": time.monotonic() - job["created_s"], "ready_mib": _memory_mib()}
    import can  # noqa: PLC0415  # as the node has imported it

    frames, expected = ([bytes.fromhex(text) for text in job[name]] for name in ("frames", "expected"))
    messages = [can.Message(arbitration_id=job["identifier"], is_extended_id=False, data=frame) for frame in frames]
    source, target = (can.Bus(channel, "virtual", ignore_config=True) for channel in job["channels"])
    sent = received = wrong = 0
    with source, target:
        while received < job["count"]:
            block = min(_BLOCK, job["count"] - sent) if received else 1
            for k in range(sent, sent + block):
                source.send(messages[k % len(messages)])
            sent += block
            while received < sent:
                message = target.recv(_PATIENCE_S)
                if message is None:
                    raise TimeoutError(f"frame {received} never came")
                if message.arbitration_id == job["identifier"]:
                    wrong += message.data != expected[received % len(expected)]
                    received += 1
            if received == 1:
                seen |= {"start_s": time.monotonic() - job["created_s"], "beside_mib": _memory_mib()}
        seen |= {"end_mib": _memory_mib(), "received": received, "wrong": wrong}
        heavy = ("numpy", "pandas", "asammdf", "cvxpy", "matplotlib")
        seen["heavy_modules"] = sum(name in sys.modules for name in heavy)


def _memory_mib() -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024.0


if __name__ == "__main__":
    main()
