"""A real ``ecu-node run`` on the virtual bus, with a thread beside it that sends to it; started by :mod:`bench.node`.

The thread waits for a line on standard input, sends frames, compares the answers, and ends the node; it prints what it
measured as JSON. It imports nothing that the node itself does not, so the memory measured here is the node's.
"""

import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

_BLOCK = 100
"""Frames that are sent before waiting for their answers."""
_PATIENCE_S = 5.0


def main() -> None:
    """Run the node until the thread beside it has sent all its frames, or failed."""
    job = json.loads(sys.argv[1])
    threading.Thread(target=_send, args=(job,), daemon=True).start()
    from ecu_node.cli import run_ecu_node  # noqa: PLC0415  # its start is measured

    sys.exit(run_ecu_node(job["arguments"]))


def _send(job: dict[str, Any]) -> None:
    """Send ``count`` frames, print how much memory there was after the first and the last one, and end the node."""
    try:
        sys.stdin.readline()
        import can  # noqa: PLC0415  # as the node has imported it

        expected, memory_mib = [bytes.fromhex(text) for text in job["expected"]], list[float]()
        messages = [can.Message(arbitration_id=job["identifier"], is_extended_id=False, data=bytes.fromhex(text))
                    for text in job["frames"]]  # fmt: skip
        source, target = (can.Bus(channel, "virtual", ignore_config=True) for channel in job["channels"])
        with source, target:
            sent = 0
            while sent < job["count"]:
                block = range(sent, min(sent + _BLOCK, job["count"]) if sent else 1)
                for k in block:
                    source.send(messages[k % len(messages)])
                for k in block:
                    while (message := target.recv(_PATIENCE_S)) and message.arbitration_id != job["identifier"]:
                        pass
                    if message is None or message.data != expected[k % len(expected)]:
                        raise ValueError(f"frame {k}: {message} came instead of {expected[k % len(expected)].hex()}")
                sent = block.stop
                if sent == 1:
                    memory_mib.append(_memory_mib())
        print(json.dumps([*memory_mib, _memory_mib()]), flush=True)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)


def _memory_mib() -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024.0


if __name__ == "__main__":
    main()
