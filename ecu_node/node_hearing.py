"""How both kinds of node hear a bus: before they are at work, and then frame by frame between two ticks."""

import time
from collections.abc import Callable

import can

from ecu_node.clocks import steady_time_s
from ecu_node.errors import BusError
from ecu_node.node_ticks import LONGEST_WAIT_S, Ticking
from ecu_node.own_frames import OwnFrames
from ecu_node.steady_bus import SteadyBus

__all__ = ["another_node", "discard", "hear", "listen", "require_own"]

_LISTEN_PERIODS, _LONGEST_LISTEN_S = 1.5, 1.5
"""So many status periods, but no longer than this [s], the node listens for another one before it says anything."""


def listen(bus: SteadyBus, own: OwnFrames, stop: Callable[[], bool], period_s: float) -> None:
    """Hear whether anybody else sends what only this node may send; what else comes meanwhile is too old afterwards.

    Parameters
    ----------
    bus : SteadyBus
        Where to listen.
    own : OwnFrames
        What only this node may send there.
    stop : callable
        Asked at every wake-up; True ends it.
    period_s : float
        Between status messages, which another node would send, too. [s]

    Raises
    ------
    BusError
        If another node sends such a message.
    """
    end_s = time.monotonic() + min(_LISTEN_PERIODS * period_s, _LONGEST_LISTEN_S)
    while (left_s := end_s - time.monotonic()) > 0.0 and not stop():
        message = bus.receive(min(left_s, LONGEST_WAIT_S))
        if message is None or message.is_remote_frame:
            continue
        if (message.arbitration_id, message.is_extended_id) in own:
            require_own(message, own, bus)


def discard(bus: SteadyBus) -> None:
    """Forget what has come so far, within a short time: on a full bus more comes meanwhile."""
    end_s = time.monotonic() + LONGEST_WAIT_S
    while time.monotonic() < end_s and bus.receive(0.0) is not None:
        pass


def hear(
    bus: SteadyBus,
    heard_s: float,
    ticking: Ticking,
    take: Callable[[can.Message, float, float], None],
    flush: Callable[[], None],
) -> float:
    """Take what comes until there is something else to do.

    Parameters
    ----------
    bus : SteadyBus
        Where to listen.
    heard_s : float
        Up to when it was heard before. [s]
    ticking : Ticking
        Says when there is something else to do.
    take : callable
        Takes a frame, the steady clock [s], and by how much the time of day is ahead of it [s].
    flush : callable
        Sends what was made of the frames; called before this waits for more, and at the end.

    Returns
    -------
    float
        Up to when the bus was heard: until it was asked last, or, if there may be more, until the last frame came; as
        before if that is not known. After a pause of the whole process, frames of all branches wait to be read, and
        none of these is stale. [s]
    """
    message = bus.receive(ticking.wait_s(bus.asked_s))
    ahead_s = ticking.time_of_day.ahead_s()  # after the wait, in which the clock may have been set
    while message is not None:
        now_s = bus.read_s
        take(message, now_s, ahead_s)
        if not bus.at_hand:
            flush()
            if ticking.is_due(now_s):
                return steady_time_s(message.timestamp, now_s, ahead_s) if message.timestamp else heard_s
        message = bus.receive(0.0)
    flush()  # error frames may have ended a batch, or the bus
    return bus.asked_s


def require_own(message: can.Message, own: OwnFrames, bus: SteadyBus) -> None:
    """Refuse one of the node's own frames that it did not send; raises as :func:`another_node` says."""
    if own.is_foreign((message.arbitration_id, message.is_extended_id), bytes(message.data)):
        raise another_node(message, bus)


def another_node(message: can.Message, bus: SteadyBus) -> BusError:
    """What to say of a frame that only this node may send, and another one did."""
    return BusError(
        f"{bus.channel}: another node sends frames 0x{message.arbitration_id:X}, which only this one may send there; "
        f"two nodes on one bus, or two buses that are joined? Stop one"
    )
