"""Random frames through both kinds of node, each compared with what must come of it; ends at the first wrong bit.

    python -m bench.node_fuzz --frames 10000000

The nodes are whole, their buses scripted: frames of branches, valid and not, of all lengths; frames of anybody else;
remote and error frames. Every few thousand frames another random vehicle takes its turn. What is drawn depends on the
seed alone.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random

import can

from bench.node_fuzz_oracle import FuzzFrame, Oracle
from bench.node_fuzz_vehicles import FuzzMessage, FuzzVehicle, draw_vehicle
from ecu_node.bus.node import GatewayNode, OverlayNode
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.wiring import InForce, Mode, wire
from ecu_node.core.status import Counters
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters

__all__ = ["WrongFrameError", "fuzz"]

FRAMES_PER_VEHICLE = 20_000
_FOREVER_S = 1e6
_FD_SIZES = (*range(9), 12, 16, 20, 24, 32, 48, 64)


class WrongFrameError(Exception):
    """The node made something else of a frame than it must."""


def fuzz(frames: int, seed: int = 0, frames_per_vehicle: int = FRAMES_PER_VEHICLE) -> Iterator[int]:
    """Send random frames through an overlay node and a gateway.

    Parameters
    ----------
    frames : int
        How many in all.
    seed : int
        Of all that is drawn.
    frames_per_vehicle : int
        After so many another vehicle is drawn.

    Yields
    ------
    int
        How many frames were right so far.

    Raises
    ------
    WrongFrameError
        At the first frame of which something else came than must.
    """
    done = 0
    while done < frames:
        count = min(frames_per_vehicle, frames - done)
        _try_vehicle(Random(f"{seed} {done}"), count, f"seed {seed}, vehicle of frame {done}")  # noqa: S311 (no secrets)
        done += count
        yield done


def _try_vehicle(rng: Random, count: int, where: str) -> None:
    vehicle = draw_vehicle(rng)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        database, parameters = vehicle.load(Path(folder))
        frames = list(_frames(rng, vehicle, count))
        for mode in Mode:
            sent = _passed(database, parameters, mode, frames)
            oracle = Oracle(vehicle, database, mode)
            for number, (frame, answers) in enumerate(zip(frames, sent, strict=True)):
                problem = oracle.problem(frame, answers)
                if problem is not None:
                    made = " ".join(answer.text() for answer in answers) or "nothing"
                    place = f"{where}, {mode.name.lower()}, frame {number}"
                    raise WrongFrameError(f"{place}: {frame.text()} -> {made}: {problem}")


def _frames(rng: Random, vehicle: FuzzVehicle, count: int) -> Iterator[FuzzFrame]:
    senders = [_Sender(rng, message) for message in vehicle.sources]
    own = {message.key for message in vehicle.targets}
    for _ in range(count):
        frame = rng.choice(senders).frame() if rng.random() < 0.75 else _foreign_frame(rng, vehicle)
        if frame.key not in own or frame.error:  # another node on the bus would end the run
            yield frame
        else:
            yield frame._replace(error=True, fd=False, bitrate_switch=False, remote=False, data=b"", dlc=0)


def _foreign_frame(rng: Random, vehicle: FuzzVehicle) -> FuzzFrame:
    """A frame of others, a remote frame of anybody, or an error frame."""
    chance, extended = rng.random(), rng.random() < 0.3
    identifier = rng.getrandbits(29 if extended else 11)
    if chance < 0.1:
        return FuzzFrame(identifier, extended, b"", error=True)
    if chance < 0.3:
        if rng.random() < 0.5:
            identifier, extended = rng.choice(vehicle.sources).key
        return FuzzFrame(identifier, extended, b"", remote=True, dlc=rng.randint(0, 8))
    if chance < 0.5:  # the number of a branch's message with the other length of identifier
        number, other = rng.choice(vehicle.sources).key
        if not other or number < 1 << 11:
            identifier, extended = number, not other
    fd = rng.random() < 0.4
    size = rng.choice(_FD_SIZES) if fd else rng.randint(0, 8)
    return FuzzFrame(
        identifier, extended, rng.randbytes(size), fd=fd, bitrate_switch=fd and rng.random() < 0.5, dlc=size
    )


class _Sender:
    """Sends one message of the vehicle, mostly as it should be."""

    def __init__(self, rng: Random, message: FuzzMessage) -> None:
        self._rng, self._message = rng, message
        self._counter = 0

    def frame(self) -> FuzzFrame:
        """The next frame."""
        rng, message = self._rng, self._message
        size = message.size if rng.random() < 0.85 else rng.randint(0, 64)
        payload = bytearray(rng.randbytes(size))
        if rng.random() < 0.25:
            self._put_special_code(payload)
        protection = message.protection
        if protection is not None and size >= protection.least and rng.random() < 0.98:
            step = 1 if rng.random() < 0.9 else rng.choice((0, 2, 3, rng.randrange(protection.modulus)))
            self._counter = (self._counter + step) % protection.modulus
            protection.protect(payload, self._counter)
            if rng.random() < 0.04:
                payload[rng.randrange(size)] ^= 1 << rng.randrange(8)
                if rng.random() < 0.5:  # only length, data identifier or counter may tell
                    protection.write_crc(payload)
        fd = size > 8 or rng.random() < 0.2
        key = message.key
        return FuzzFrame(*key, bytes(payload), fd=fd, bitrate_switch=fd and rng.random() < 0.5, dlc=size)

    def _put_special_code(self, payload: bytearray) -> None:
        """An end of the range, a named code, or one beside them."""
        rng = self._rng
        signal = rng.choice(self._message.signals) if self._message.signals else None
        if signal is None or signal.end > len(payload):
            return
        codes = [*signal.named, *signal.unnamed, *signal.width_range, *(signal.range or ()), 0]
        lowest, highest = signal.width_range
        signal.put(payload, min(max(rng.choice(codes) + rng.choice((0, 0, 1, -1)), lowest), highest))


class _ScriptedBus(can.BusABC):
    """Hands frames out one after the other, and keeps what is sent until the next one is asked for."""

    def __init__(self, frames: Sequence[FuzzFrame], sent: list[list[FuzzFrame]]) -> None:
        super().__init__("scripted")
        self.channel_info = "scripted"
        self._frames, self._next, self._sent = frames, 0, sent
        self.begun = self.done = False
        """Whether the node has begun its work: before that it only listens to others."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.done or not self.begun:
            time.sleep(min(timeout or 0.0, 0.02))
            return None
        if self._next == len(self._frames):
            self.done = True
            return None
        frame = self._frames[self._next]
        self._next += 1
        self._sent.append([])
        return can.Message(
            timestamp=time.time() if self._next % 2 else 0.0,  # of the kernel, or none
            arbitration_id=frame.identifier,
            is_extended_id=frame.extended,
            is_fd=frame.fd,
            bitrate_switch=frame.bitrate_switch,
            is_remote_frame=frame.remote,
            is_error_frame=frame.error,
            dlc=frame.dlc,
            data=bytearray(frame.data) if not frame.remote else None,
        )

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 (as python-can has it)
        self._sent[-1].append(
            FuzzFrame(
                msg.arbitration_id,
                msg.is_extended_id,
                bytes(msg.data),
                fd=msg.is_fd,
                bitrate_switch=msg.bitrate_switch,
                remote=msg.is_remote_frame,
                error=msg.is_error_frame,
                dlc=msg.dlc,
            )
        )


def _passed(
    database: VehicleDatabase, parameters: VehicleParameters, mode: Mode, frames: Sequence[FuzzFrame]
) -> list[list[FuzzFrame]]:
    """What a node sends for each frame."""
    sent: list[list[FuzzFrame]] = []
    script, silent = _ScriptedBus(frames, sent), _ScriptedBus((), sent)

    def begin(_: float, __: bool) -> None:
        script.begun = True

    corrector = wire(database, InForce(parameters=parameters), time.monotonic(), mode=mode)
    corrector.watch.is_whole = lambda _: False  # random currents do not sum to zero
    near, far = SteadyBus(lambda: script, Counters()), SteadyBus(lambda: silent, Counters())
    node = (
        OverlayNode(near, corrector, period_s=_FOREVER_S, on_tick=begin)
        if mode is Mode.OVERLAY
        else GatewayNode(near, far, corrector, period_s=_FOREVER_S, on_tick=begin)
    )
    node.run(lambda: script.done)
    near.close()
    far.close()
    return sent


def main() -> int:
    """Try as many frames as asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    start_s = time.monotonic()
    done = 0
    try:
        for done in fuzz(arguments.frames, arguments.seed):
            if done % (50 * FRAMES_PER_VEHICLE) == 0:
                print(f"{done} frames, {done / (time.monotonic() - start_s):.0f} frames/s", file=sys.stderr, flush=True)
    except WrongFrameError as error:
        print(error, file=sys.stderr)
        return 1
    print(f"{done} frames right in both modes, {done / (time.monotonic() - start_s):.0f} frames/s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
