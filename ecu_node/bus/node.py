"""The node on one bus (overlay) or between two (gateway): a thin shell around the core, with clock and buses.

An overlay node works in one thread. In a gateway one thread corrects the sensors' frames and passes them on, another
passes frames back from the vehicle. Frames that the kernel carries are passed on by neither.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import can

from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Counters, Latency
from ecu_node.errors import BusError

_OLDEST_FRAME_S = 10.0
"""No frame waits for longer than this, unless the whole process pauses. [s]"""
_LARGEST_JITTER_S = 0.05
"""If the time of day changes by more than this against the steady clock, it was set. [s]"""


def steady_time_s(stamp_s: float, now_s: float, clock_ahead_s: float) -> float:
    """Return when a frame came, on the steady clock.

    Parameters
    ----------
    stamp_s : float
        Its time stamp by the kernel or the adapter, in time of day; 0 if there is none. [s]
    now_s : float
        The steady clock now. [s]
    clock_ahead_s : float
        By how much the time of day is ahead of the steady clock; infinity if it was set a short while ago. [s]

    Returns
    -------
    float
        The stamp on the steady clock; ``now_s`` if there is none, it lies in the future, or the clock was set. [s]
    """
    if stamp_s == 0.0 or clock_ahead_s == float("inf"):
        return now_s
    return min(stamp_s - clock_ahead_s, now_s)


class TimeOfDay:
    """Tells by how much the time of day is ahead of the steady clock, and notices when it is set.

    Parameters
    ----------
    counters : Counters
        Counters, in which it counts how often the time of day was set.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters, self._set_s, self._ahead_s = counters, float("-inf"), float("nan")
        while self._ahead_s != self._ahead_s:
            self._read()

    def ahead_s(self) -> float:
        """Return by how much the time of day is ahead [s]; infinity while frames stamped before it was set may wait."""
        before_s = self._ahead_s
        now_s = self._read()
        if abs(self._ahead_s - before_s) > _LARGEST_JITTER_S:
            self._set_s = now_s
            self._counters.clock_steps += 1
        return self._ahead_s if now_s - self._set_s > _OLDEST_FRAME_S else float("inf")

    def _read(self) -> float:
        """Compare both clocks, unless the process was held up in between; return the steady one. [s]"""
        now_s = time.monotonic()
        ahead_s = time.time() - now_s
        if time.monotonic() - now_s < _LARGEST_JITTER_S:
            self._ahead_s = ahead_s
        return now_s


_REMEMBERED = 256
"""Most frames of one identifier that the node has sent and may still receive itself."""
_Key = tuple[int, bool]
"""An identifier, and whether it has 29 bits."""


class OwnFrames:
    """Frames that only this node may send on a bus; it remembers which it sent, as it may receive its own.

    Parameters
    ----------
    keys : iterable of tuple
        Identifiers, each with whether it has 29 bits.
    remembered : int
        Number of frames of each identifier that the node has sent and may still receive itself.
    """

    def __init__(self, keys: Iterable[_Key], remembered: int = _REMEMBERED) -> None:
        self._sent: dict[_Key, deque[bytes | bytearray]] = {key: deque(maxlen=remembered) for key in keys}

    def sent(self, key: _Key, data: bytes | bytearray) -> None:
        """Remember a frame that is sent."""
        self._sent[key].append(data)

    def is_foreign(self, key: _Key, data: bytes | bytearray) -> bool:
        """Check whether another node must have sent this frame; one that was sent from here may be received once."""
        try:
            self._sent[key].remove(data)
        except ValueError:
            return True
        return False

    def __contains__(self, key: _Key) -> bool:
        return key in self._sent


_LONGEST_WAIT_S = 0.1
"""The node wakes up at least this often, so that a request to stop is seen. [s]"""
_LOOK_EVERY_S = 0.02
"""The junction is looked at, and the watchdog fed, at least this often, even if the status is sent more rarely. [s]"""
_LISTEN_PERIODS, _LONGEST_LISTEN_S = 1.5, 1.5
"""The node listens for another one before it sends: for this many status periods, but no longer than this [s]."""

_LONGEST_TURN_S = 2.0
"""A gateway's thread from vehicle to sensors counts as alive if it has looked for frames within this time. [s]"""
_LONGEST_DELAY_S = 1.0
"""A gateway drops a branch's frame that has waited longer than this and than the branch's timeout. [s]"""
_COPIES, _COPIES_WITHIN_S = 10, 2.0
"""This many copies of one bus's frames on the other, within this time [s], show that both are the same bus."""
_REMEMBERED_COPIES = 16
"""Number of frames of each identifier that may be on their way from one bus to the other."""


@dataclass
class _Job:
    """Something that is done periodically, between frames."""

    period_s: float
    do: Callable[[float], None]
    due_s: float = float("-inf")

    def run(self, now_s: float) -> None:
        """Do the job; it is next due one period after it was due, or after now if it is a whole period late."""
        self.do(now_s)
        in_step_s = self.due_s + self.period_s
        self.due_s = in_step_s if in_step_s > now_s else now_s + self.period_s


class Node:
    """Takes frames as they come, and in between looks at the junction and sends the status.

    It does one of these at a time, and a frame that comes meanwhile waits for that one only.

    Parameters
    ----------
    sensors, vehicle : SteadyBus
        Bus on which the sensors are heard, and bus on which the node answers and sends its status: the same one for an
        overlay node, two for a gateway.
    corrector : Corrector
        The core.
    period_s : float
        Time between status messages. [s]
    on_tick : callable
        Called after each look at the junction, with the steady clock [s], and True if all threads work.
    latency : Latency
        Histogram to which the latencies of answers are added.
    routed : bool
        Whether the kernel carries all identifiers except those that only the gateway may send to the vehicle.
    """

    def __init__(
        self,
        sensors: SteadyBus,
        vehicle: SteadyBus,
        corrector: Corrector,
        *,
        period_s: float,
        on_tick: Callable[[float, bool], None] = lambda _, __: None,
        latency: Latency | None = None,
        routed: bool = False,
    ) -> None:
        self._sensors, self._vehicle, self._corrector = sensors, vehicle, corrector
        self._period_s, self._on_tick, self._latency = period_s, on_tick, latency or Latency()
        self._is_gateway, self._routed = vehicle is not sensors, routed
        self._take = self._pass_on if self._is_gateway else self._answer
        self._own = self._not_from_vehicle = OwnFrames(corrector.own_keys)
        if self._is_gateway:
            self._not_from_vehicle = OwnFrames(corrector.own_keys | corrector.branch_keys, _REMEMBERED_COPIES)
        self._copies: deque[float] = deque(maxlen=_COPIES)
        """When copies of frames from one bus came from the other bus. [s]"""
        self._time_of_day = TimeOfDay(corrector.counters)
        self._heard_s = self._due_s = self._back_s = float("-inf")
        often_s = min(period_s, _LOOK_EVERY_S)
        self._jobs = [_Job(often_s, self._look), _Job(period_s, self._tell)]

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
        self._listen(stop)
        if not self._is_gateway:
            ready()
            self._work(stop)
            return
        end_s = time.monotonic() + _LONGEST_WAIT_S  # a limit, as a busy bus never runs empty
        while time.monotonic() < end_s and self._sensors.receive(0.0) is not None:
            pass  # too old by now
        ready()
        self._back_s = time.monotonic()
        ended = threading.Event()
        with ThreadPoolExecutor(1, "back") as pool:
            back = pool.submit(self._pass_back, lambda: stop() or ended.is_set())
            try:
                self._work(lambda: stop() or back.done())
            finally:
                ended.set()
        back.result()  # raises what ended it

    def _listen(self, stop: Callable[[], bool]) -> None:
        """Listen for another node that sends what only this one may; drop all else, which is too old afterwards."""
        end_s = time.monotonic() + min(_LISTEN_PERIODS * self._period_s, _LONGEST_LISTEN_S)
        while (left_s := end_s - time.monotonic()) > 0.0 and not stop():
            message = self._vehicle.receive(min(left_s, _LONGEST_WAIT_S))
            if message is not None and not message.is_remote_frame:
                key = (message.arbitration_id, message.is_extended_id)
                if key in self._not_from_vehicle and self._not_from_vehicle.is_foreign(key, message.data):
                    raise _another_node(message, self._vehicle)

    def _work(self, stop: Callable[[], bool]) -> None:
        """Take frames, and do the jobs when they are due, until `stop` returns True."""
        self._heard_s = time.monotonic()
        while not stop():
            now_s = self._sensors.asked_s
            job = min(self._jobs, key=lambda job: job.due_s)
            if now_s >= job.due_s:
                job.run(now_s)
                self._due_s = min(job.due_s for job in self._jobs)
            self._hear()

    def _look(self, now_s: float) -> None:
        """Look at the junction at the time up to which the bus was heard, then call `on_tick` with the time [s]."""
        self._corrector.look(self._heard_s)  # frames that wait to be read make no branch stale
        self._on_tick(now_s, not self._is_gateway or time.monotonic() - self._back_s < _LONGEST_TURN_S)

    def _tell(self, _: float) -> None:
        """Send the status message, if the layout has one."""
        status = self._corrector.status()
        if status is not None:
            self._own.sent(status.key, status.data)
            self._vehicle.send(_data_frame(status.key, status.data, fd=status.fd))
            self._corrector.counters.send_errors += self._vehicle.flush()[1]

    def _hear(self) -> None:
        """Take frames until there is something else to do, and note up to which time the bus was heard.

        That is when it was asked last, or, if more frames may wait, when the last one came. So no branch is stale after
        a pause of the whole process, while frames of all branches wait to be read.
        """
        bus = self._sensors
        message = bus.receive(min(_LONGEST_WAIT_S, max(0.0, self._due_s - bus.asked_s)))
        ahead_s = self._time_of_day.ahead_s()  # after the wait, in which the clock may have been set
        while message is not None:
            now_s = bus.read_s
            self._take(message, now_s, ahead_s)
            if not bus.at_hand:
                self._flush()
                if now_s >= self._due_s:
                    if message.timestamp:
                        self._heard_s = steady_time_s(message.timestamp, now_s, ahead_s)
                    return
            message = bus.receive(0.0)
        self._flush()  # for a batch that was ended by error frames, or by a bus that failed
        self._heard_s = bus.asked_s

    def _answer(self, message: can.Message, now_s: float, ahead_s: float) -> None:
        """Overlay: answer a frame; given the steady clock, and how far the time of day is ahead of it. [s]"""
        if message.is_remote_frame:
            return
        key, corrector = (message.arbitration_id, message.is_extended_id), self._corrector
        if key in self._own:
            if self._own.is_foreign(key, message.data):
                raise _another_node(message, self._vehicle)
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
            self._own.sent(target.key, target.data)
            fd = target.fd or message.is_fd
            self._vehicle.send(_data_frame(target.key, target.data, fd=fd, bitrate_switch=message.bitrate_switch))
            self._latency.came(time_s)

    def _pass_on(self, message: can.Message, now_s: float, ahead_s: float) -> None:
        """Gateway: pass a frame on to the vehicle, with the currents of branches corrected."""
        key, source = (message.arbitration_id, message.is_extended_id), None
        if not message.is_remote_frame:
            if key in self._own:
                self._refuse(message, self._sensors, self._own)
                return
            source = self._corrector.sources.get(key)
        if source is not None:
            if key in self._not_from_vehicle:
                self._not_from_vehicle.sent(key, message.data)
            time_s = steady_time_s(message.timestamp, now_s, ahead_s)
            if now_s - time_s > max(source.timeout_s, _LONGEST_DELAY_S):
                self._corrector.counters.late += 1
                return
            data = source.forward(message.data, time_s)
            if data is None:
                return
            message.data = data
            self._latency.came(time_s)
        if not self._routed or key in self._not_from_vehicle:
            self._vehicle.send(message)

    def _flush(self) -> None:
        """Send the answers or frames that are queued, and count them."""
        sent, not_sent = self._vehicle.flush()
        self._corrector.counters.send_errors += not_sent
        self._latency.sent(not_sent)
        if self._is_gateway:
            self._corrector.counters.forwarded += sent

    def _pass_back(self, stop: Callable[[], bool]) -> None:
        """Pass frames from the vehicle on to the sensors' bus, except those that only this side may send."""
        vehicle, own, counters = self._vehicle, self._not_from_vehicle, self._corrector.counters
        while not stop():
            message = vehicle.receive(_LONGEST_WAIT_S)
            if message is not None:
                key = (message.arbitration_id, message.is_extended_id)
                if key in own and not message.is_remote_frame:
                    self._refuse(message, vehicle, own)
                elif not self._routed or key in own:
                    self._sensors.send(message)
            if not vehicle.at_hand:
                self._back_s = time.monotonic()
                sent, not_sent = self._sensors.flush()
                counters.returned += sent
                counters.not_returned += not_sent

    def _refuse(self, message: can.Message, bus: SteadyBus, own: OwnFrames) -> None:
        """Drop a frame that only this node may send there, and go on: its sender must not stop the branches' frames.

        Many copies of the other bus's frames end the node, as frames would go round in circles: both are the same bus.
        """
        if not own.is_foreign((message.arbitration_id, message.is_extended_id), message.data):
            now_s = time.monotonic()
            self._copies.append(now_s)
            if len(self._copies) == _COPIES and now_s - self._copies[0] < _COPIES_WITHIN_S:
                raise _another_node(message, bus)
        self._corrector.counters.foreign += 1
        bus.say(
            f"{bus.channel}: another node sends frames 0x{message.arbitration_id:X}, which only this one may send "
            f"there; they are dropped; find out who it is"
        )


def _data_frame(key: _Key, data: bytes | bytearray, *, fd: bool, bitrate_switch: bool = False) -> can.Message:
    """Make a frame to be sent."""
    return can.Message(
        arbitration_id=key[0], is_extended_id=key[1], is_fd=fd, bitrate_switch=bitrate_switch, data=data, is_rx=False
    )


def _another_node(message: can.Message, bus: SteadyBus) -> BusError:
    return BusError(
        f"{bus.channel}: another node sends frames 0x{message.arbitration_id:X}, which only this one may send there; "
        f"two nodes on one bus, or two buses that are joined? Stop one"
    )
