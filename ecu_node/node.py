"""The node on its buses: a thin shell around :class:`~ecu_node.corrector.Corrector` that owns clock, buses and threads.

An overlay node works on one bus, in one thread. A gateway has the sensors on one bus and the rest of the vehicle on the
other: one thread passes frames on from the sensors, and corrects, another one passes all others on the other way.
"""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import can

from ecu_node.buses import SteadyBus, connect
from ecu_node.clocks import TimeOfDay, steady_time_s
from ecu_node.corrector import Corrector
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError
from ecu_node.guard import Mode, needs_fd, received, rewritten, transmitted
from ecu_node.own_frames import OwnFrames

__all__ = ["GatewayNode", "OverlayNode", "open_bus", "receive_filters"]

_LONGEST_WAIT_S = 0.1
"""A wake-up at least this often, so that a request to stop is seen. [s]"""
_LOOK_EVERY_S = 0.1
"""The junction is looked at, and the watchdog fed, at least this often, however rare the status is. [s]"""
_LISTEN_PERIODS, _LONGEST_LISTEN_S = 1.5, 1.5
"""So many status periods, but no longer than this [s], the node listens for another one before it says anything."""
_LONGEST_TURN_S = 2.0
"""A gateway's way back is at work if it has looked for frames within this time. [s]"""
_LONGEST_DELAY_S = 1.0
"""A gateway passes a branch's frame on only if it waited no longer than this, or than the branch's timeout. [s]"""
_STANDARD_MASK = 0x7FF
_EXTENDED_MASK = 0x1FFFFFFF


def receive_filters(database: VehicleDatabase) -> list[can.typechecking.CanFilter]:
    """Filters of an overlay node, for the kernel to apply: the branches' messages, and its own as sent by others."""
    return [
        {
            "can_id": key.identifier,
            "can_mask": _EXTENDED_MASK if key.extended else _STANDARD_MASK,
            "extended": key.extended,
        }
        for key in (*received(database), *transmitted(database, Mode.OVERLAY))
    ]


def open_bus(database: VehicleDatabase, *, interface: str, channel: str, fd: bool, mode: Mode) -> can.BusABC:
    """Open a bus for the node.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    interface, channel : str
        As python-can names them, such as socketcan and can0.
    fd : bool
        Whether to use CAN FD.
    mode : Mode
        An overlay node receives what it needs, a gateway everything.

    Returns
    -------
    can.BusABC
        The bus; it does not receive what it sends.

    Raises
    ------
    BusError
        If there is no such bus, or the DBC needs CAN FD and ``fd`` is not given.
    """
    if not fd and (names := needs_fd(database, mode)):
        raise BusError(f"{database.layout.dbc_path}: CAN FD messages ({', '.join(names)}); start with --fd")
    filters = receive_filters(database) if mode is Mode.OVERLAY else None
    return connect(interface, channel, fd=fd, filters=filters)


class _Ticking:
    """What both kinds of node do now and then: look at the junction, publish the status, and whatever else is due.

    Parameters
    ----------
    corrector : Corrector
        The core.
    period_s : float
        Between status messages. [s]
    on_tick : callable
        Called with the steady clock's time after each look. [s]
    """

    def __init__(self, corrector: Corrector, period_s: float, on_tick: Callable[[float], None]) -> None:
        self._corrector, self.period_s, self._on_tick = corrector, period_s, on_tick
        self._due_s = self._status_due_s = float("-inf")
        self.time_of_day = TimeOfDay(corrector.counters)

    def is_due(self, now_s: float) -> bool:
        """Whether there is something else to do than to receive."""
        return now_s >= self._due_s

    def wait_s(self, now_s: float) -> float:
        """How long there is nothing to do but to receive; 0 if it is time. [s]"""
        return min(_LONGEST_WAIT_S, max(0.0, self._due_s - now_s))

    def tick(self, now_s: float, heard_s: float, bus: SteadyBus, own: OwnFrames) -> None:
        """Do it if it is due; no branch is stale for what has not been heard yet. The bus is flushed before."""
        if now_s < self._due_s:
            return
        self._due_s = _next_s(self._due_s, min(self.period_s, _LOOK_EVERY_S), now_s)
        corrector = self._corrector
        corrector.look(heard_s)
        status = corrector.status() if now_s >= self._status_due_s else None
        if status is not None:
            self._status_due_s = _next_s(self._status_due_s, self.period_s, now_s)
            fields, data = status
            own.sent(fields.key, data)
            bus.send(_message(fields.key, data, fd=fields.fd))
            corrector.counters.send_errors += bus.flush()[1]
        self._on_tick(now_s)


def _next_s(due_s: float, period_s: float, now_s: float) -> float:
    """When something periodic is due again: in step, unless it is late by a whole period. [s]"""
    return due_s + period_s if due_s + period_s > now_s else now_s + period_s


def _hear(
    bus: SteadyBus, ticking: _Ticking, take: Callable[[can.Message, float, float], None], flush: Callable[[], None]
) -> float:
    """Take what comes until there is something else to do.

    Parameters
    ----------
    bus : SteadyBus
        Where to listen.
    ticking : _Ticking
        Says when there is something else to do.
    take : callable
        Takes a frame, the steady clock [s], and by how much the time of day is ahead of it [s].
    flush : callable
        Sends what was made of the frames; called before this waits for more, and at the end.

    Returns
    -------
    float
        Up to when the bus was heard: now, or when the last frame came if there may be more. After a pause of the whole
        process, frames of all branches wait to be read, and none of these is stale. [s]
    """
    message = bus.receive(ticking.wait_s(bus.asked_s))
    ahead_s = ticking.time_of_day.ahead_s()  # after the wait, in which the clock may have been set
    while message is not None:
        now_s = bus.asked_s
        take(message, now_s, ahead_s)
        if not bus.at_hand:
            flush()
            if ticking.is_due(now_s):
                return steady_time_s(message.timestamp, now_s, ahead_s)
        message = bus.receive(0.0)
    return bus.asked_s


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
    on_tick : callable
        Called with the steady clock's time at every status message. [s]
    """

    def __init__(
        self,
        bus: SteadyBus,
        corrector: Corrector,
        database: VehicleDatabase,
        *,
        period_s: float,
        on_tick: Callable[[float], None] = lambda _: None,
    ) -> None:
        self._bus, self._corrector = bus, corrector
        self._own = OwnFrames(transmitted(database, Mode.OVERLAY))
        self._ticking = _Ticking(corrector, period_s, on_tick)

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
        _listen(self._bus, self._own, stop, self._ticking.period_s)
        ready()
        bus, ticking = self._bus, self._ticking
        heard_s = time.monotonic()
        while not stop():
            ticking.tick(bus.asked_s, heard_s, bus, self._own)
            heard_s = _hear(bus, ticking, self._take, self._flush)

    def _take(self, message: can.Message, now_s: float, ahead_s: float) -> None:
        if message.is_remote_frame:
            return
        key = (message.arbitration_id, message.is_extended_id)
        corrector, own = self._corrector, self._own
        if key in own:
            _require_own(message, own, self._bus)
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
            answer = _message(
                target.key, target.data, fd=target.fd or message.is_fd, bitrate_switch=message.bitrate_switch
            )
            self._bus.send(answer)

    def _flush(self) -> None:
        self._corrector.counters.send_errors += self._bus.flush()[1]


class GatewayNode:
    """Corrects between two buses.

    Parameters
    ----------
    sensors : SteadyBus
        The bus on which the sensors are.
    vehicle : SteadyBus
        The bus on which the corrected values are needed; the status goes there too.
    corrector, database, period_s, on_tick :
        As for :class:`OverlayNode`.
    """

    def __init__(
        self,
        sensors: SteadyBus,
        vehicle: SteadyBus,
        corrector: Corrector,
        database: VehicleDatabase,
        *,
        period_s: float,
        on_tick: Callable[[float], None] = lambda _: None,
    ) -> None:
        self._sensors, self._vehicle, self._corrector = sensors, vehicle, corrector
        own = transmitted(database, Mode.GATEWAY)
        self._status = OwnFrames(own)
        self._not_from_vehicle = OwnFrames([*own, *rewritten(database)])
        self._on_tick = on_tick
        self._ticking = _Ticking(corrector, period_s, self._while_both_ways_work)
        self._back_s = float("-inf")

    def run(self, stop: Callable[[], bool], ready: Callable[[], None] = lambda: None) -> None:
        """Correct until told to stop; parameters and errors as for :meth:`OverlayNode.run`."""
        _listen(self._vehicle, self._not_from_vehicle, stop, self._ticking.period_s)
        _discard(self._sensors)
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

    def _while_both_ways_work(self, now_s: float) -> None:
        """Let the watchdog see it if the way back is stuck."""
        if time.monotonic() - self._back_s < _LONGEST_TURN_S:
            self._on_tick(now_s)

    def _pass_on(self, stop: Callable[[], bool]) -> None:
        sensors, vehicle, ticking = self._sensors, self._vehicle, self._ticking
        heard_s = time.monotonic()
        while not stop():
            ticking.tick(sensors.asked_s, heard_s, vehicle, self._status)
            heard_s = _hear(sensors, ticking, self._take, self._flush)

    def _take(self, message: can.Message, now_s: float, ahead_s: float) -> None:
        key = (message.arbitration_id, message.is_extended_id)
        corrector = self._corrector
        source = None if message.is_remote_frame else corrector.sources.get(key)
        if key in self._status and not message.is_remote_frame:
            raise _another(message, self._sensors)
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

    def _pass_back(self, stop: Callable[[], bool]) -> None:
        """Pass on what the vehicle sends to the sensors' bus; a branch's frame from there must not be."""
        vehicle, sensors, counters = self._vehicle, self._sensors, self._corrector.counters
        while not stop():
            self._back_s = time.monotonic()
            received = vehicle.receive(_LONGEST_WAIT_S)
            while received is not None:
                key = (received.arbitration_id, received.is_extended_id)
                if key in self._not_from_vehicle and not received.is_remote_frame:
                    raise _another(received, vehicle)
                sensors.send(received)
                if not vehicle.at_hand:
                    sent, not_sent = sensors.flush()
                    counters.returned += sent
                    counters.not_returned += not_sent
                    self._back_s = time.monotonic()
                received = None if stop() else vehicle.receive(0.0)


def _listen(bus: SteadyBus, own: OwnFrames, stop: Callable[[], bool], period_s: float) -> None:
    """Hear whether anybody else sends what only this node may send; what else comes meanwhile is too old afterwards."""
    end_s = time.monotonic() + min(_LISTEN_PERIODS * period_s, _LONGEST_LISTEN_S)
    while (left_s := end_s - time.monotonic()) > 0.0 and not stop():
        message = bus.receive(min(left_s, _LONGEST_WAIT_S))
        if message is None or message.is_remote_frame:
            continue
        if (message.arbitration_id, message.is_extended_id) in own:
            _require_own(message, own, bus)


def _discard(bus: SteadyBus) -> None:
    """Forget what has come so far, within a short time: on a full bus more comes meanwhile."""
    end_s = time.monotonic() + _LONGEST_WAIT_S
    while time.monotonic() < end_s and bus.receive(0.0) is not None:
        pass


def _require_own(message: can.Message, own: OwnFrames, bus: SteadyBus) -> None:
    if own.is_foreign((message.arbitration_id, message.is_extended_id), bytes(message.data)):
        raise _another(message, bus)


def _another(message: can.Message, bus: SteadyBus) -> BusError:
    return BusError(
        f"{bus.channel}: another node sends frames 0x{message.arbitration_id:X}, which only this one may send there; "
        f"two nodes on one bus, or two buses that are joined? Stop one"
    )


def _message(key: tuple[int, bool], data: bytes | bytearray, *, fd: bool, bitrate_switch: bool = False) -> can.Message:
    identifier, extended = key
    return can.Message(
        arbitration_id=identifier,
        is_extended_id=extended,
        is_fd=fd,
        bitrate_switch=bitrate_switch,
        data=data,
        is_rx=False,
    )
