"""A node in this process that answers many frames; prints what that did to memory as JSON."""

import gc
import json
import os
import signal
import sys
import threading
from pathlib import Path

from ecu_node.program import load_python_can

load_python_can()

import can  # noqa: E402

from ecu_node.cli import main  # noqa: E402
from ecu_node.database import read_database  # noqa: E402
from ecu_node.layout import read_layout  # noqa: E402
from tests.ecu_node.vehicles import protected  # noqa: E402

AT_ONCE, WARM_UP = 100, 5_000
"""Frames that are on their way at most; frames until all that remembers the last ones is full."""


def drive(layout: Path, frames: int) -> None:
    """Send frames of the battery, wait for their answers, then end the node."""
    database = read_database(read_layout(layout))
    data = [protected(database, "HV_Battery", k) for k in range(15)]
    answers = 0
    with can.Bus("many", "virtual") as bus:

        def pass_through(count: int) -> None:
            nonlocal answers
            for _ in range(count // AT_ONCE):
                wanted = answers + AT_ONCE
                for k in range(answers, wanted):
                    bus.send(can.Message(arbitration_id=0x110, is_extended_id=False, data=data[k % 15]))
                while answers < wanted:
                    message = bus.recv(10.0)
                    assert message is not None
                    answers += message.arbitration_id == 0x510

        while (message := bus.recv(10.0)) is None or message.arbitration_id != 0x5F0:  # the node is at work
            pass
        pass_through(WARM_UP)
        objects, collections = len(gc.get_objects()), [of["collections"] for of in gc.get_stats()]
        pass_through(frames)
        seen = {
            "grown_objects": len(gc.get_objects()) - objects,
            "collections": sum(of["collections"] for of in gc.get_stats()) - sum(collections),
            "frozen": gc.get_freeze_count(),
            "answers": answers - WARM_UP,
        }
    print(json.dumps(seen))
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    layout, folder, frames = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    threading.Thread(target=drive, args=(layout, frames), daemon=True).start()
    files = ["--unsigned", "--params", str(folder / "none.json"), "--layout", str(layout)]
    files += ["--telemetry", str(folder / "telemetry.jsonl"), "--realtime"]
    sys.exit(main(["run", *files, "--interface", "virtual", "--channel", "many"]))
