"""The whole node on python-can's virtual bus, beside the plain version and a loop that only receives and sends.

The virtual bus lives in one process: who sends, who receives and what is measured are threads that share one
interpreter, and every hop copies the message. So two figures are given for each. The time per frame is that of the
whole process, the same sender and receiver included. The processor time per frame is that of what is measured alone,
its receiving and sending included: that of the process less that of the threads that send and receive.
"""

import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import quantiles

import can

from bench.node_plain import plain_job
from bench.node_vehicle import IDENTIFIER, NUMBERS, OUT_IDENTIFIER, BenchVehicle, make_vehicle
from bench.row import Row
from ecu_node.bus.node import GatewayNode, OverlayNode
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.wiring import Mode, open_bus
from ecu_node.core.status import Counters

__all__ = ["BUS_LOAD_HZ", "load_rows", "rows"]

BUS_LOAD_HZ = 24_316.0
"""Frames of 8 bytes on a full CAN FD bus of 1 and 8 Mbit/s."""
LATENCY_HZ = 1000.0
"""Frames come one by one at this rate while their latency is measured."""
PERIOD_S = 0.1
"""Between status messages. [s]"""
SETTLE_S = 0.3
"""A node listens to others for a moment before it begins. [s]"""
BLOCK, BLOCKS = 100, 2
"""As fast as it goes, so many frames are on their way at most."""
PATIENCE_S = 5.0
"""A frame that is not there by then is lost. [s]"""
ROUNDS = 3
"""In which all take their turns: what else the machine does hits one of them, and the best counts."""
MEBIBYTE = 1024.0**2

Channels = tuple[str, str]
Contender = Callable[[BenchVehicle, Channels], AbstractContextManager[None]]


@dataclass(frozen=True, kw_only=True)
class Passage:
    """What was seen of frames on their way.

    Attributes
    ----------
    per_frame_s : float
        Time from the first frame to the last one, by their number. [s]
    cpu_s : float
        Processor time per frame of what was measured. [s]
    lost, wrong : int
        Frames that never came, and those that are not what they should be at their place.
    most_underway : int
        Most frames sent but not received.
    latencies_s : list of float
        Of the single frames, where asked for. [s]
    grown_bytes : float
        What the process' resident memory grew by. [byte]
    """

    per_frame_s: float
    cpu_s: float
    lost: int
    wrong: int
    most_underway: int
    latencies_s: list[float]
    grown_bytes: float


def rows(frames: int, latency_frames: int) -> list[Row]:
    """Measure rate, latency and processor time.

    Parameters
    ----------
    frames : int
        Sent as fast as they are taken.
    latency_frames : int
        Sent one by one.

    Returns
    -------
    list of Row
        For the node in both modes, beside the plain version of the same mode and the bare loop.
    """
    found: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        vehicle = make_vehicle(Path(folder), numbered=True)
        rounds = [
            {name: _pass(name, contender, vehicle, frames) for name, contender in CONTENDERS.items()}
            for _ in range(ROUNDS)
        ]
        single = {
            name: _pass(name, contender, vehicle, latency_frames, rate_hz=LATENCY_HZ)
            for name, contender in CONTENDERS.items()
        }
    seen = {name: _best([found[name] for found in rounds]) for name in CONTENDERS}
    for name, plain in (("gateway", "plain gateway"), ("overlay", "plain overlay")):
        for peer in ("bare loop", plain):
            found += _beside(name, seen[name], peer, seen[peer])
        found.append(Row(name=f"virtual bus, {name}: CPU per 10^6 frames", value=1e6 * seen[name].cpu_s, unit="s"))
    for name, passage in single.items():
        found += _latency_rows(name, passage)
    return found


def load_rows(frames: int) -> list[Row]:
    """See whether a gateway holds the load of a full bus.

    Parameters
    ----------
    frames : int
        How many are sent, in bursts of 1 ms.

    Returns
    -------
    list of Row
        Frames lost, out of order or wrong; the backlog; the growth of memory; and the highest rate.
    """
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        vehicle = make_vehicle(Path(folder), numbered=True)
        held = _pass("gateway", gateway_node, vehicle, frames, rate_hz=BUS_LOAD_HZ)
        fastest = _pass("gateway", gateway_node, vehicle, frames // 10)
    label = f"gateway at {BUS_LOAD_HZ:.0f} frames/s, {frames:,} frames"
    return [
        Row(name=f"{label}: lost", value=held.lost, unit="1"),
        Row(name=f"{label}: out of order or wrong", value=held.wrong, unit="1"),
        Row(name=f"{label}: rate", value=1.0 / held.per_frame_s, unit="frames/s"),
        Row(name=f"{label}: most underway", value=held.most_underway, unit="frames"),
        Row(name=f"{label}: CPU share of the node", value=100.0 * held.cpu_s / held.per_frame_s, unit="%"),
        Row(name=f"{label}: growth of the process", value=held.grown_bytes / MEBIBYTE, unit="MiB"),
        Row(
            name="gateway, highest rate with sender and receiver beside it",
            value=1.0 / fastest.per_frame_s,
            unit="frames/s",
            peer=f"a full CAN FD bus, {BUS_LOAD_HZ:.0f} frames/s",
            ratio=1.0 / fastest.per_frame_s / BUS_LOAD_HZ,
        ),
    ]


def _beside(name: str, ours: Passage, peer: str, other: Passage) -> list[Row]:
    return [
        Row(
            name=f"virtual bus, {name} beside {peer}: time per frame, sender and receiver included",
            value=1e6 * ours.per_frame_s,
            unit="us",
            peer=f"{peer}, {1e6 * other.per_frame_s:.1f} us",
            ratio=other.per_frame_s / ours.per_frame_s,
        ),
        Row(
            name=f"virtual bus, {name} beside {peer}: CPU per frame, alone",
            value=1e6 * ours.cpu_s,
            unit="us",
            peer=f"{peer}, {1e6 * other.cpu_s:.1f} us",
            ratio=other.cpu_s / ours.cpu_s,
        ),
    ]


def _latency_rows(name: str, passage: Passage) -> list[Row]:
    cuts = quantiles(passage.latencies_s, n=1000, method="inclusive")
    return [
        Row(name=f"virtual bus, {name}: latency, {label}", value=1e6 * cuts[place - 1], unit="us")
        for label, place in (("median", 500), ("99 %", 990), ("99.9 %", 999))
    ]


def _best(passages: Sequence[Passage]) -> Passage:
    """Least time and least processor time of some passages."""
    quickest = min(passages, key=lambda item: item.per_frame_s)
    return replace(quickest, cpu_s=min(item.cpu_s for item in passages))


def _pass(
    name: str, contender: Contender, vehicle: BenchVehicle, frames: int, *, rate_hz: float | None = None
) -> Passage:
    """Let a contender pass frames on, and look at what arrives."""
    overlay = name.endswith("overlay")
    channels = (f"{name} in", f"{name} in" if overlay else f"{name} out")
    with (
        can.Bus(channels[0], "virtual", ignore_config=True) as sending,
        nullcontext(sending) if overlay else can.Bus(channels[1], "virtual", ignore_config=True) as receiving,
        contender(vehicle, channels),
    ):
        time.sleep(SETTLE_S)
        harness = _Harness(vehicle, sending, receiving, frames, latency=rate_hz == LATENCY_HZ)
        passage = harness.run(OUT_IDENTIFIER if overlay else IDENTIFIER, _expected(name, vehicle), rate_hz)
    if rate_hz != BUS_LOAD_HZ and (passage.lost or (rate_hz is None and passage.wrong)):
        raise RuntimeError(f"{name}: {passage.lost} of {frames} frames lost, {passage.wrong} wrong")
    return passage


def _expected(name: str, vehicle: BenchVehicle) -> list[bytes]:
    """One round of what must arrive."""
    if name == "bare loop":
        return [bytes(payload) for payload in vehicle.frames]
    mode = Mode.OVERLAY if name.endswith("overlay") else Mode.GATEWAY
    if name.startswith("plain"):
        job = plain_job(vehicle, mode)
        return [bytes(payload) for payload in map(job, vehicle.frames) if payload is not None]
    return vehicle.corrected(mode)


class _Harness:
    """Sends frames in a thread of its own and receives them in this one."""

    def __init__(
        self, vehicle: BenchVehicle, sending: can.BusABC, receiving: can.BusABC, frames: int, *, latency: bool
    ) -> None:
        self._messages = [
            can.Message(arbitration_id=IDENTIFIER, is_extended_id=False, data=payload) for payload in vehicle.frames
        ]
        self._sending, self._receiving, self._frames = sending, receiving, frames
        self._sent, self._sent_s = 0, [0.0] * NUMBERS
        self._latency = latency
        self._room = threading.Semaphore(BLOCKS)
        self._sender_cpu_s = 0.0

    def run(self, identifier: int, expected: Sequence[bytes], rate_hz: float | None) -> Passage:
        target = self._send_freely if rate_hz is None else lambda: self._send_paced(rate_hz)
        sender = threading.Thread(target=lambda: self._clocked(target), daemon=True)
        before_bytes, start_s = resident_bytes(), time.perf_counter()
        cpu_s, own_cpu_s = time.process_time(), time.thread_time()
        sender.start()
        received, wrong, most_underway, latencies_s = self._receive(identifier, expected)
        end_s = time.perf_counter()
        own_cpu_s = time.thread_time() - own_cpu_s
        self._frames = 0  # a sender that waits for frames that never come may end
        self._room.release(BLOCKS)
        sender.join()
        cpu_s = time.process_time() - cpu_s - own_cpu_s - self._sender_cpu_s
        return Passage(
            per_frame_s=(end_s - start_s) / max(received, 1),
            cpu_s=cpu_s / max(received, 1),
            lost=self._sent - received,
            wrong=wrong,
            most_underway=most_underway,
            latencies_s=latencies_s,
            grown_bytes=resident_bytes() - before_bytes,
        )

    def _clocked(self, send: Callable[[], None]) -> None:
        send()
        self._sender_cpu_s = time.thread_time()

    def _send_freely(self) -> None:
        messages, send = self._messages, self._sending.send
        while self._sent < self._frames:
            self._room.acquire()
            for k in range(self._sent, min(self._sent + BLOCK, self._frames)):
                send(messages[k % NUMBERS])
                self._sent = k + 1

    def _send_paced(self, rate_hz: float) -> None:
        """In bursts of 1 ms; after a delay all that is due is sent."""
        messages, send, sent_s, clock = self._messages, self._sending.send, self._sent_s, time.perf_counter
        start_s = clock()
        while self._sent < self._frames:
            due = min(int((clock() - start_s) * rate_hz) + 1, self._frames)
            for k in range(self._sent, due):
                sent_s[k % NUMBERS] = clock()
                send(messages[k % NUMBERS])
                self._sent = k + 1
            time.sleep(0.001)

    def _receive(self, identifier: int, expected: Sequence[bytes]) -> tuple[int, int, int, list[float]]:
        """How many frames came and how many were wrong, the most underway, and the latencies. [s]"""
        receive, clock, sent_s, room = self._receiving.recv, time.perf_counter, self._sent_s, self._room
        received = wrong = most_underway = 0
        latencies_s: list[float] = []
        last_s = clock()
        while received < self._frames:
            message = receive(PATIENCE_S)
            if message is None or message.arbitration_id != identifier:
                if clock() - last_s > PATIENCE_S:
                    break
                continue
            last_s = clock()
            number = received % NUMBERS
            if message.data != expected[number]:
                wrong += 1
            if self._latency:
                latencies_s.append(clock() - sent_s[number])
            received += 1
            if not received % BLOCK:
                most_underway = max(most_underway, self._sent - received)
                room.release()
        return received, wrong, most_underway, latencies_s


@contextmanager
def gateway_node(vehicle: BenchVehicle, channels: Channels) -> Iterator[None]:
    """The node between two channels."""
    corrector = vehicle.corrector(Mode.GATEWAY)
    with (
        _node_bus(vehicle, channels[0], Mode.GATEWAY) as sensors,
        _node_bus(vehicle, channels[1], Mode.GATEWAY) as far_side,
    ):
        node = GatewayNode(sensors, far_side, corrector, period_s=PERIOD_S)
        with _running(node.run):
            yield


@contextmanager
def overlay_node(vehicle: BenchVehicle, channels: Channels) -> Iterator[None]:
    """The node on one channel."""
    corrector = vehicle.corrector(Mode.OVERLAY)
    with (
        _node_bus(vehicle, channels[0], Mode.OVERLAY) as bus,
        _running(OverlayNode(bus, corrector, period_s=PERIOD_S).run),
    ):
        yield


@contextmanager
def bare_loop(vehicle: BenchVehicle, channels: Channels) -> Iterator[None]:  # noqa: ARG001 (all take the same)
    """Receives and sends, and no more."""
    with (
        can.Bus(channels[0], "virtual", ignore_config=True) as receiving,
        can.Bus(channels[1], "virtual", ignore_config=True) as sending,
    ):

        def run(stop: Callable[[], bool]) -> None:
            while not stop():
                message = receiving.recv(0.1)
                while message is not None:
                    sending.send(message)
                    message = receiving.recv()
                    if message is not None and message.is_error_frame:  # its own end
                        return

        with _running(run):
            yield
            with can.Bus(channels[0], "virtual", ignore_config=True) as ending:
                ending.send(can.Message(is_error_frame=True))


@contextmanager
def plain_gateway(vehicle: BenchVehicle, channels: Channels) -> Iterator[None]:
    """A listener that decodes and encodes with cantools."""
    job = plain_job(vehicle, Mode.GATEWAY)
    with (
        can.Bus(channels[0], "virtual", ignore_config=True) as receiving,
        can.Bus(channels[1], "virtual", ignore_config=True) as sending,
    ):

        def on_message(message: can.Message) -> None:
            data = job(message.data) if message.arbitration_id == IDENTIFIER else message.data
            if data is not None:
                message.data = data
                sending.send(message)

        with can.Notifier(receiving, [on_message]):
            yield


@contextmanager
def plain_overlay(vehicle: BenchVehicle, channels: Channels) -> Iterator[None]:
    """The same on one channel."""
    job = plain_job(vehicle, Mode.OVERLAY)
    with can.Bus(channels[0], "virtual", ignore_config=True) as bus:

        def on_message(message: can.Message) -> None:
            data = job(message.data) if message.arbitration_id == IDENTIFIER else None
            if data is not None:
                bus.send(can.Message(arbitration_id=OUT_IDENTIFIER, is_extended_id=False, data=data))

        with can.Notifier(bus, [on_message]):
            yield


CONTENDERS: dict[str, Contender] = {
    "gateway": gateway_node,
    "overlay": overlay_node,
    "bare loop": bare_loop,
    "plain gateway": plain_gateway,
    "plain overlay": plain_overlay,
}


@contextmanager
def _node_bus(vehicle: BenchVehicle, channel: str, mode: Mode) -> Iterator[SteadyBus]:
    bus = SteadyBus(
        lambda: open_bus(vehicle.database, interface="virtual", channel=channel, fd=False, mode=mode), Counters()
    )
    try:
        yield bus
    finally:
        bus.close()


@contextmanager
def _running(run: Callable[[Callable[[], bool]], None]) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=run, args=(stop.is_set,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def resident_bytes() -> float:
    """Resident memory of this process. [byte]"""
    return int(Path("/proc/self/statm").read_text().split()[1]) * float(os.sysconf("SC_PAGE_SIZE"))
