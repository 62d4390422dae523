"""The node between two buses: the sensors on one, the rest of the vehicle on the other.

A thin shell around :class:`~ecu_node.corrector.Corrector` that owns clock, buses and threads: one thread passes frames
on from the sensors, and corrects, another one passes all others on the other way.
"""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import can

from ecu_node.clocks import steady_time_s
from ecu_node.corrector import Corrector
from ecu_node.database import VehicleDatabase
from ecu_node.guard import Mode, rewritten, transmitted
from ecu_node.node_hearing import another_node, discard, hear, listen
from ecu_node.node_ticks import LONGEST_WAIT_S, OnTick, Ticking
from ecu_node.own_frames import OwnFrames
from ecu_node.steady_bus import SteadyBus

__all__ = ["GatewayNode"]

_LONGEST_TURN_S = 2.0
"""A gateway's way back is at work if it has looked for frames within this time. [s]"""
_LONGEST_DELAY_S = 1.0
"""A gateway passes a branch's frame on only if it waited no longer than this, or than the branch's timeout. [s]"""


class GatewayNode:
    """Corrects between two buses.

    Parameters
    ----------
    sensors : SteadyBus
        The bus on which the sensors are.
    vehicle : SteadyBus
        The bus on which the corrected values are needed; the status goes there too.
    corrector, database, period_s, on_tick :
        As for :class:`~ecu_node.overlay_node.OverlayNode`.
    """

    def __init__(
        self,
        sensors: SteadyBus,
        vehicle: SteadyBus,
        corrector: Corrector,
        database: VehicleDatabase,
        *,
        period_s: float,
        on_tick: OnTick = lambda _, __: None,
    ) -> None:
        self._sensors, self._vehicle, self._corrector = sensors, vehicle, corrector
        own = transmitted(database, Mode.GATEWAY)
        self._status = OwnFrames(own)
        self._not_from_vehicle = OwnFrames([*own, *rewritten(database)])
        self._ticking = Ticking(corrector, period_s, on_tick, self._is_back_at_work)
        self._back_s = float("-inf")

    def run(self, stop: Callable[[], bool], ready: Callable[[], None] = lambda: None) -> None:
        """Correct until told to stop; parameters and errors as for :meth:`~ecu_node.overlay_node.OverlayNode.run`."""
        listen(self._vehicle, self._not_from_vehicle, stop, self._ticking.period_s)
        discard(self._sensors)
        ready()
        self._back_s = time.monotonic()
        ended = threading.Event()
        with ThreadPoolExecutor(1, "back") as pool:
            back = pool.submit(self._pass_back, lambda: stop() or ended.is_set())
            try:
                self._pass_on(lambda: stop() or back.done())
            finally:
                ended.set()
        back.result()  # raises what ended it

    def _is_back_at_work(self) -> bool:
        return time.monotonic() - self._back_s < _LONGEST_TURN_S

    def _pass_on(self, stop: Callable[[], bool]) -> None:
        sensors, vehicle, ticking = self._sensors, self._vehicle, self._ticking
        heard_s = time.monotonic()
        while not stop():
            ticking.tick(sensors.asked_s, heard_s, vehicle, self._status)
            heard_s = hear(sensors, heard_s, ticking, self._take, self._flush)

    def _take(self, message: can.Message, now_s: float, ahead_s: float) -> None:
        key = (message.arbitration_id, message.is_extended_id)
        corrector = self._corrector
        source = None if message.is_remote_frame else corrector.sources.get(key)
        if key in self._status and not message.is_remote_frame:
            raise another_node(message, self._sensors)
        if source is not None:
            time_s = steady_time_s(message.timestamp, now_s, ahead_s)
            if now_s - time_s > max(source.timeout_s, _LONGEST_DELAY_S):
                corrector.counters.late += 1
                return
            data = source.forward(message.data, time_s)
            if data is None:
                return
            message.data = data
        self._vehicle.send(message)

    def _flush(self) -> None:
        counters = self._corrector.counters
        sent, not_sent = self._vehicle.flush()
        counters.forwarded += sent
        counters.send_errors += not_sent

    def _flush_back(self) -> None:
        self._back_s = time.monotonic()
        counters = self._corrector.counters
        sent, not_sent = self._sensors.flush()
        counters.returned += sent
        counters.not_returned += not_sent

    def _pass_back(self, stop: Callable[[], bool]) -> None:
        """Pass on what the vehicle sends to the sensors' bus; a branch's frame from there must not be."""
        vehicle, sensors = self._vehicle, self._sensors
        while not stop():
            received = vehicle.receive(LONGEST_WAIT_S)
            while received is not None:
                key = (received.arbitration_id, received.is_extended_id)
                if key in self._not_from_vehicle and not received.is_remote_frame:
                    raise another_node(received, vehicle)
                sensors.send(received)
                if not vehicle.at_hand:
                    self._flush_back()
                received = None if stop() else vehicle.receive(0.0)
            self._flush_back()
