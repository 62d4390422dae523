"""What the node computes for one frame of a branch, without its buses, beside the same work with cantools."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter

from bench.node_plain import plain_job
from bench.node_vehicle import IDENTIFIER, BenchVehicle, make_vehicle
from bench.row import Row
from ecu_node.bus.wiring import Mode

__all__ = ["rows"]

_ONE_CODE_A = 0.1
"""cantools rounds halves to even codes, the node upwards. [A]"""


def rows(repeats: int) -> list[Row]:
    """Measure.

    Parameters
    ----------
    repeats : int
        Rounds of frames, of which the quickest counts; the node and its peer take turns.

    Returns
    -------
    list of Row
        Time per frame of either mode.
    """
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        vehicle = make_vehicle(Path(folder), numbered=False)
        return [_row(vehicle, mode, repeats) for mode in Mode]


def _row(vehicle: BenchVehicle, mode: Mode, repeats: int) -> Row:
    _require_equal(vehicle, mode)
    node, plain = _node_round(vehicle, mode), _plain_round(vehicle, mode)
    seconds, peer_seconds = [], []
    for _ in range(repeats):
        seconds.append(_timed_s(node))
        peer_seconds.append(_timed_s(plain))
    count = len(vehicle.frames)
    per_frame_s, peer_s = min(seconds) / count, min(peer_seconds) / count
    return Row(
        name=f"branch frame, {mode.name.lower()}, two currents and P01, no bus",
        value=1e6 * per_frame_s,
        unit="us",
        peer=f"cantools decode and encode, {1e6 * peer_s:.1f} us",
        ratio=peer_s / per_frame_s,
    )


def _node_round(vehicle: BenchVehicle, mode: Mode) -> Callable[[], None]:
    """One round of frames as the loop over a bus hands them to the core."""
    corrector, frames = vehicle.corrector(mode), vehicle.frames
    find, key, is_overlay = corrector.sources.get, (IDENTIFIER, False), mode is Mode.OVERLAY

    def overlay() -> None:
        for payload in frames:
            source = find(key)
            if source is not None:
                source.answer(payload, 0.0)

    def gateway() -> None:
        for payload in frames:
            source = find(key)
            if source is not None:
                source.forward(payload, 0.0)

    return overlay if is_overlay else gateway


def _plain_round(vehicle: BenchVehicle, mode: Mode) -> Callable[[], None]:
    job, frames = plain_job(vehicle, mode), vehicle.frames

    def run() -> None:
        for payload in frames:
            job(payload)

    return run


def _timed_s(run: Callable[[], None]) -> float:
    start = perf_counter()
    run()
    return perf_counter() - start


def _require_equal(vehicle: BenchVehicle, mode: Mode) -> None:
    """Refuse to compare ways that give different results."""
    message = vehicle.database.message("Pair" if mode is Mode.GATEWAY else "PairOut")
    job = plain_job(vehicle, mode)
    made = vehicle.corrected(mode)
    others = [bytes(payload) for payload in map(job, vehicle.frames) if payload is not None]
    for ours, other in zip(made, others, strict=True):
        a, b = message.decode_simple(ours), message.decode_simple(other)
        for name in _names(a):
            difference = abs(float(a[name]) - float(b[name]))  # type: ignore[arg-type]
            if difference > (1.01 * _ONE_CODE_A if name in {"Battery", "Motor"} else 0.0):
                raise RuntimeError(f"{name} of {ours.hex()} differs from that of {other.hex()} by {difference}")


def _names(values: object) -> Iterator[str]:
    assert isinstance(values, dict)
    return (name for name in values if name != "Crc")  # follows from the others
