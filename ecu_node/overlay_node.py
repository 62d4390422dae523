"""The node on one bus: a thin shell around :class:`~ecu_node.corrector.Corrector` that owns clock and bus.

It works in one thread.
"""

import time
from collections.abc import Callable

import can

from ecu_node.clocks import steady_time_s
from ecu_node.corrector import Corrector
from ecu_node.database import VehicleDatabase
from ecu_node.guard import Mode, transmitted
from ecu_node.links import data_frame
from ecu_node.node_hearing import hear, listen, require_own
from ecu_node.node_ticks import OnTick, Ticking
from ecu_node.own_frames import OwnFrames
from ecu_node.steady_bus import SteadyBus

__all__ = ["OverlayNode"]


class OverlayNode:
    """Corrects on one bus.

    Parameters
    ----------
    bus : SteadyBus
        The bus.
    corrector : Corrector
        The core.
    database : VehicleDatabase
        Layout and DBC.
    period_s : float
        Between status messages. [s]
    on_tick : OnTick
        Called after each look at the junction.
    """

    def __init__(
        self,
        bus: SteadyBus,
        corrector: Corrector,
        database: VehicleDatabase,
        *,
        period_s: float,
        on_tick: OnTick = lambda _, __: None,
    ) -> None:
        self._bus, self._corrector = bus, corrector
        self._own = OwnFrames(transmitted(database, Mode.OVERLAY))
        self._ticking = Ticking(corrector, period_s, on_tick)

    def run(self, stop: Callable[[], bool], ready: Callable[[], None] = lambda: None) -> None:
        """Correct until told to stop.

        Parameters
        ----------
        stop : callable
            Asked at every wake-up; True ends the work.
        ready : callable
            Called when the node has listened and is at work; frames before that are not answered.

        Raises
        ------
        BusError
            If another node sends this node's messages.
        """
        listen(self._bus, self._own, stop, self._ticking.period_s)
        ready()
        bus, ticking = self._bus, self._ticking
        heard_s = time.monotonic()
        while not stop():
            ticking.tick(bus.asked_s, heard_s, bus, self._own)
            heard_s = hear(bus, heard_s, ticking, self._take, self._flush)

    def _take(self, message: can.Message, now_s: float, ahead_s: float) -> None:
        if message.is_remote_frame:
            return
        key = (message.arbitration_id, message.is_extended_id)
        corrector, own = self._corrector, self._own
        if key in own:
            require_own(message, own, self._bus)
            corrector.counters.echoes += 1
            return
        source = corrector.sources.get(key)
        if source is None:
            return
        time_s = steady_time_s(message.timestamp, now_s, ahead_s)
        if now_s - time_s > source.timeout_s:
            corrector.counters.late += 1
            return
        for target in source.answer(message.data, time_s):
            own.sent(target.key, target.data)
            answer = data_frame(
                target.key, target.data, fd=target.fd or message.is_fd, bitrate_switch=message.bitrate_switch
            )
            self._bus.send(answer)

    def _flush(self) -> None:
        self._corrector.counters.send_errors += self._bus.flush()[1]
