"""What the node is compared with on SocketCAN, as processes: a loop that receives and sends, and the plain version."""

import signal
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import can

__all__ = ["main"]


def main() -> None:
    """Pass frames on until ended: ``python -m bench.node_peer bare|plain CHANNEL_IN CHANNEL_OUT``."""
    kind, source, target = sys.argv[1:]
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # as the node does: no numpy beside python-can
    import can  # noqa: PLC0415  # after that

    with (
        can.Bus(source, "socketcan", ignore_config=True) as receiving,
        can.Bus(target, "socketcan", ignore_config=True) as sending,
    ):
        if kind == "bare":
            _bare(receiving, sending)
        else:
            _plain(receiving, sending)


def _bare(receiving: "can.BusABC", sending: "can.BusABC") -> None:
    while True:
        message = receiving.recv()
        if message is not None:
            sending.send(message)


def _plain(receiving: "can.BusABC", sending: "can.BusABC") -> None:
    import can  # noqa: PLC0415  # as in main

    from bench.node_plain import plain_job  # noqa: PLC0415  # the bare loop does without
    from bench.node_vehicle import IDENTIFIER, make_vehicle  # noqa: PLC0415
    from ecu_node.bus.wiring import Mode  # noqa: PLC0415

    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        job = plain_job(make_vehicle(Path(folder), numbered=True), Mode.GATEWAY)

    def on_message(message: can.Message) -> None:
        data = job(message.data) if message.arbitration_id == IDENTIFIER else message.data
        if data is not None:
            message.data = data
            sending.send(message)

    with can.Notifier(receiving, [on_message]):
        signal.pause()


if __name__ == "__main__":
    main()
