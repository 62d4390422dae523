"""The node on a virtual bus, which lives in one process: plays a log to it, and prints how many answers came.

A program for environments that have the node alone: LOG, and the arguments of 'ecu-node run' with --channel drive.
"""

import os
import signal
import sys
import threading
import time

import can

from ecu_node.cli import run_ecu_node

CORRECTED_BATTERY = 0x510
"""HV_BatteryCorrected of hv_powertrain.dbc."""
ENOUGH = 50
PATIENCE_S = 60.0


def play(log: str) -> None:
    """Send frames until enough corrected ones have come back, and end the node."""
    until_s, found = time.monotonic() + PATIENCE_S, 0
    with can.Bus(interface="virtual", channel="drive") as bus:
        while found < ENOUGH and time.monotonic() < until_s:
            for frame in can.LogReader(log):
                frame.channel = None
                bus.send(frame)
                time.sleep(0.001)
                while (answer := bus.recv(0.0)) is not None:
                    found += answer.arbitration_id == CORRECTED_BATTERY
                if found >= ENOUGH:
                    break
    print(found, flush=True)
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=play, args=(sys.argv[1],)).start()
    sys.exit(run_ecu_node(["run", *sys.argv[2:]]))
