"""The node on one bus (overlay), and between two (gateway): thin shells around the core that own clock and buses.

An overlay node works in one thread. In a gateway one thread passes frames on from the sensors, and corrects; another
one passes all others on the other way. Where the kernel carries what is only passed on, neither does so again.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import can

from ecu_node.bus.guard import Mode, rewritten, transmitted
from ecu_node.bus.links import data_frame
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.telemetry import Latency
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Counters
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError

__all__ = ["GatewayNode", "OverlayNode", "TimeOfDay", "steady_time_s"]


_OLDEST_FRAME_S = 10.0
"""No frame waits for longer, unless the whole process pauses. [s]"""
_LARGEST_JITTER_S = 0.05
"""By more than this the time of day changes against the steady clock only if it is set. [s]"""


def steady_time_s(stamp_s: float, now_s: float, clock_ahead_s: float) -> float:
    """When a frame came, on the steady clock.

    Parameters
    ----------
    stamp_s : float
        Its time stamp by the kernel or the adapter; 0 if there is none. [s]
    now_s : float
        The steady clock now. [s]
    clock_ahead_s : float
        By how much the time of day is ahead of the steady clock; infinity if it was set a short while ago. [s]

    Returns
    -------
    float
        The stamp on the steady clock; now if there is none, it would be in the future, or the clock was set.
    """
    if stamp_s == 0.0 or clock_ahead_s == float("inf"):
        return now_s
    return min(stamp_s - clock_ahead_s, now_s)


class TimeOfDay:
    """By how much the time of day is ahead of the steady clock, and whether it was set.

    Parameters
    ----------
    counters : Counters
        Where it is counted how often it was set.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        while (ahead_s := _ahead_s()) is None:
            pass
        self._ahead_s = ahead_s
        self._set_s = float("-inf")

    def ahead_s(self) -> float:
        """By how much it is ahead now [s]; infinity while frames may be waiting that were stamped before it was set."""
        now_s = time.monotonic()
        ahead_s = _ahead_s()
        if ahead_s is None:
            ahead_s = self._ahead_s
        if abs(ahead_s - self._ahead_s) > _LARGEST_JITTER_S:
            self._set_s = now_s
            self._counters.clock_steps += 1
        self._ahead_s = ahead_s
        return ahead_s if now_s - self._set_s > _OLDEST_FRAME_S else float("inf")


def _ahead_s() -> float | None:
    """By how much the time of day is ahead [s]; None if the process was held up between reading the two clocks."""
    before_s = time.monotonic()
    ahead_s = time.time() - before_s
    return ahead_s if time.monotonic() - before_s < _LARGEST_JITTER_S else None


_REMEMBERED = 256
"""Frames of one identifier that may be on their way back."""


class OwnFrames:
    """What was sent lately, by identifier.

    Parameters
    ----------
    keys : iterable of tuple
        Identifiers, each with whether it has 29 bits, that nobody but this node may send on a bus.
    """

    def __init__(self, keys: Iterable[tuple[int, bool]]) -> None:
        self._sent: dict[tuple[int, bool], deque[bytes | bytearray]] = {key: deque(maxlen=_REMEMBERED) for key in keys}

    def sent(self, key: tuple[int, bool], data: bytes | bytearray) -> None:
        """Remember a frame that is sent."""
        self._sent[key].append(data)

    def is_foreign(self, key: tuple[int, bool], data: bytes | bytearray) -> bool:
        """Whether another node must have sent this frame; one that was sent from here may come back once."""
        try:
            self._sent[key].remove(data)
        except ValueError:
            return True
        return False

    def __contains__(self, key: tuple[int, bool]) -> bool:
        return key in self._sent


LONGEST_WAIT_S = 0.1
"""A wake-up at least this often, so that a request to stop is seen. [s]"""
_LOOK_EVERY_S = 0.02
"""The junction is looked at, and the watchdog fed, at least this often, however rare the status is. [s]"""

OnTick = Callable[[float, bool], None]
"""Takes the steady clock's time [s], and whether the whole node works."""


class Ticking:
    """Does each of these when it is due.

    Parameters
    ----------
    corrector : Corrector
        The core.
    period_s : float
        Between status messages. [s]
    on_tick : OnTick
        Called after each look.
    works : callable
        Whether all that works beside this does.
    """

    def __init__(
        self, corrector: Corrector, period_s: float, on_tick: OnTick, works: Callable[[], bool] = lambda: True
    ) -> None:
        self._corrector, self.period_s, self._on_tick, self._works = corrector, period_s, on_tick, works
        self._due_s = self._status_due_s = float("-inf")
        self.time_of_day = TimeOfDay(corrector.counters)

    def is_due(self, now_s: float) -> bool:
        """Whether there is something else to do than to receive."""
        return now_s >= self._due_s

    def wait_s(self, now_s: float) -> float:
        """How long there is nothing to do but to receive; 0 if it is time. [s]"""
        return min(LONGEST_WAIT_S, max(0.0, self._due_s - now_s))

    def tick(self, now_s: float, heard_s: float, bus: SteadyBus, own: OwnFrames) -> None:
        """Do it if it is due; no branch is stale for what has not been heard yet."""
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
            bus.send(data_frame(fields.key, data, fd=fields.fd))
            corrector.counters.send_errors += bus.flush()[1]
        self._on_tick(now_s, self._works())


def _next_s(due_s: float, period_s: float, now_s: float) -> float:
    """When something periodic is due again: in step, unless it is late by a whole period. [s]"""
    return due_s + period_s if due_s + period_s > now_s else now_s + period_s


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
    latency : Latency, optional
        Where it is counted how long answers take.
    """

    def __init__(
        self,
        bus: SteadyBus,
        corrector: Corrector,
        database: VehicleDatabase,
        *,
        period_s: float,
        on_tick: OnTick = lambda _, __: None,
        latency: Latency | None = None,
    ) -> None:
        self._bus, self._corrector, self._latency = bus, corrector, latency or Latency()
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
            self._latency.came(time_s)

    def _flush(self) -> None:
        _, not_sent = self._bus.flush()
        self._corrector.counters.send_errors += not_sent
        self._latency.sent(not_sent)


_LONGEST_TURN_S = 2.0
"""A gateway's way back is at work if it has looked for frames within this time. [s]"""
_LONGEST_DELAY_S = 1.0
"""A gateway passes a branch's frame on only if it waited no longer than this, or than the branch's timeout. [s]"""


_COPIES, _COPIES_WITHIN_S = 10, 2.0
"""So many copies of one bus's frames on the other one, in so long [s], show that both are one."""
_REMEMBERED_COPIES = 16
"""Frames of each identifier that may be on their way round."""


class GatewayNode:
    """Corrects between two buses.

    Parameters
    ----------
    sensors : SteadyBus
        The bus on which the sensors are.
    vehicle : SteadyBus
        The bus on which the corrected values are needed; the status goes there too.
    corrector, database, period_s, on_tick, latency :
        As for :class:`~ecu_node.bus.node.OverlayNode`.
    routed : bool
        Whether the kernel carries all identifiers but those that only the gateway may send to the vehicle.
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
        routed: bool = False,
        latency: Latency | None = None,
    ) -> None:
        self._sensors, self._vehicle, self._corrector, self._routed = sensors, vehicle, corrector, routed
        self._latency = latency or Latency()
        own = transmitted(database, Mode.GATEWAY)
        self._status = OwnFrames(own)
        self._not_from_vehicle = OwnFrames([*own, *rewritten(database)])
        self._ticking = Ticking(corrector, period_s, on_tick, self._is_back_at_work)
        self._back_s = float("-inf")
        self._lately: dict[tuple[int, bool], deque[bytearray]] = {
            key: deque(maxlen=_REMEMBERED_COPIES) for key in rewritten(database)
        }
        self._copies: deque[float] = deque(maxlen=_COPIES)
        """When copies of one bus's frames came from the other one. [s]"""

    def run(self, stop: Callable[[], bool], ready: Callable[[], None] = lambda: None) -> None:
        """Correct until told to stop; parameters and errors as for :meth:`~ecu_node.bus.node.OverlayNode.run`."""
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
            if not self._status.is_foreign(key, message.data):
                self._require_two_buses(message, self._sensors)
            self._drop(message, self._sensors)
            return
        if source is not None:
            if key in self._lately:
                self._lately[key].append(message.data)
            time_s = steady_time_s(message.timestamp, now_s, ahead_s)
            if now_s - time_s > max(source.timeout_s, _LONGEST_DELAY_S):
                corrector.counters.late += 1
                return
            data = source.forward(message.data, time_s)
            if data is None:
                return
            message.data = data
            self._latency.came(time_s)
        if not self._routed or key in self._not_from_vehicle:
            self._vehicle.send(message)

    def _flush(self) -> None:
        counters = self._corrector.counters
        sent, not_sent = self._vehicle.flush()
        counters.forwarded += sent
        counters.send_errors += not_sent
        self._latency.sent(not_sent)

    def _flush_back(self) -> None:
        self._back_s = time.monotonic()
        counters = self._corrector.counters
        sent, not_sent = self._sensors.flush()
        counters.returned += sent
        counters.not_returned += not_sent

    def _drop(self, message: can.Message, bus: SteadyBus) -> None:
        """Somebody sends what only this node may send there: that must not stop the branches' frames."""
        self._corrector.counters.foreign += 1
        bus.say(
            f"{bus.channel}: another node sends frames 0x{message.arbitration_id:X}, which only this one may send "
            f"there; they are dropped; find out who it is"
        )

    def _require_two_buses(self, message: can.Message, bus: SteadyBus) -> None:
        """Refuse to go round in circles: on buses that are joined each frame comes from both sides."""
        now_s = time.monotonic()
        self._copies.append(now_s)
        if len(self._copies) == _COPIES and now_s - self._copies[0] < _COPIES_WITHIN_S:
            raise another_node(message, bus)

    def _pass_back(self, stop: Callable[[], bool]) -> None:
        """Pass on what the vehicle sends to the sensors' bus; a branch's frame from there must not be."""
        vehicle, sensors = self._vehicle, self._sensors
        while not stop():
            received = vehicle.receive(LONGEST_WAIT_S)
            while received is not None:
                key = (received.arbitration_id, received.is_extended_id)
                if key in self._not_from_vehicle and not received.is_remote_frame:
                    if received.data in list(self._lately.get(key, ())):
                        self._require_two_buses(received, vehicle)
                    self._drop(received, vehicle)
                elif not self._routed or key in self._not_from_vehicle:
                    sensors.send(received)
                if not vehicle.at_hand:
                    self._flush_back()
                received = None if stop() else vehicle.receive(0.0)
            self._flush_back()
