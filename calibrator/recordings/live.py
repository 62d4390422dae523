"""Frames from a live bus, as if they came from a log."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import can

from calibrator.recordings.frame_arrays import FrameCollector, Frames
from ecu_node.errors import BusError

__all__ = ["listen"]

_POLL_S = 0.1
"""How often the end of a live recording is checked. [s]"""


def listen(interface: str, channel: str | None, duration_s: float) -> Frames:
    """Take everything that comes over a bus for some time.

    Parameters
    ----------
    interface, channel : str, str or None
        Of python-can, such as ``socketcan`` and ``vcan0``.
    duration_s : float
        How long to listen. [s]

    Returns
    -------
    Frames
        At least one frame; those until then if Ctrl-C ends it early.

    Raises
    ------
    BusError
        If the bus cannot be opened, or nothing comes.
    """
    collector = FrameCollector()
    try:
        with can.Bus(interface=interface, channel=channel) as bus, _interrupt_noted() as stopped:
            end_s = time.monotonic() + duration_s
            while not stopped.is_set() and (left_s := end_s - time.monotonic()) > 0.0:
                message = bus.recv(timeout=min(left_s, _POLL_S))
                if message is not None:
                    collector.add(message)
    except (can.CanError, OSError, ValueError, TypeError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise BusError(
            f"{interface}:{channel}: cannot listen to the bus: {reason}; check --interface and --channel"
        ) from None
    if stopped.is_set() and not len(collector):
        raise KeyboardInterrupt
    if not len(collector):
        raise BusError(
            f"{interface}:{channel}: no frame in {duration_s:g} s; check that something is sent, or listen longer"
        )
    return collector.frames()


@contextmanager
def _interrupt_noted() -> Iterator[threading.Event]:
    """Within the block Ctrl-C sets this event, so that no frame is half taken; what ignores Ctrl-C goes on doing so."""
    stopped = threading.Event()
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is signal.SIG_IGN:
        yield stopped
        return
    signal.signal(signal.SIGINT, lambda *_: stopped.set())
    try:
        yield stopped
    finally:
        signal.signal(signal.SIGINT, before)
