"""Encode signals as CAN frames, with the DBC and the layout's end-to-end protection, and write them as candump log."""

import gzip
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cantools.database.can import Signal
from numpy.typing import NDArray

from calibrator.drive import Array
from calibrator.recordings.frame_arrays import CLASSIC_BYTES
from ecu_node.core.e2e import Protection, protection_of
from ecu_node.database import VehicleDatabase
from ecu_node.documents import write_atomically
from ecu_node.errors import DatabaseError

__all__ = ["FrameSeries", "encode_message", "write_candump"]


@dataclass(frozen=True, kw_only=True)
class FrameSeries:
    """Frames of one identifier.

    Attributes
    ----------
    arbitration_id, extended : int, bool
        Identifier, and whether it has 29 bits.
    time_s : ndarray of shape (n,)
        Instants of the frames, from any zero; they become the time stamps as they are. [s]
    data : ndarray of uint8 of shape (n, length)
        Payloads.
    """

    arbitration_id: int
    extended: bool
    time_s: Array
    data: NDArray[np.uint8]


def encode_message(
    database: VehicleDatabase, message_name: str, time_s: Array, values: Mapping[str, Array]
) -> FrameSeries:
    """Encode one message at given instants.

    Parameters
    ----------
    database : VehicleDatabase
        DBC and layout; a message that the layout protects gets counter and CRC.
    message_name : str
        Message of the DBC.
    time_s : ndarray of shape (n,)
        Instants of the frames. [s]
    values : mapping of str to ndarray of shape (n,)
        Physical values by signal name, in the unit of the DBC. NaN, and every signal that is not given, becomes the
        signal's code SNA where it has one, else code 0. Values beyond the signal's range saturate.

    Returns
    -------
    FrameSeries
        The frames.

    Raises
    ------
    DatabaseError
        If values are given for a floating-point signal.
    """
    message = database.message(message_name)
    bits = np.zeros((len(time_s), 8 * message.length), dtype=np.uint8)
    for signal in message.signals:
        raw = _raw_codes(signal, values.get(signal.name, np.full(len(time_s), np.nan)))
        for weight, position in enumerate(_bit_positions(signal)):
            bits[:, position] = (raw >> weight) & 1
    data = np.packbits(bits, axis=1, bitorder="little")
    protection = protection_of(database, message)
    if protection is not None:
        _protect(data, protection)
    return FrameSeries(
        arbitration_id=message.frame_id, extended=message.is_extended_frame, time_s=np.asarray(time_s), data=data
    )


def write_candump(path: Path, series: Iterable[FrameSeries]) -> int:
    """Write frames as ``candump -L`` does, in the order of their instants, with can0 as their channel.

    Parameters
    ----------
    path : Path
        ``.log``, or ``.log.gz`` to compress.
    series : iterable of FrameSeries
        The frames, one series per identifier.

    Returns
    -------
    int
        Number of frames written.
    """
    lines: list[str] = []
    times: list[Array] = []
    for item in series:
        name = f"{item.arbitration_id:08X}" if item.extended else f"{item.arbitration_id:03X}"
        text = item.data.tobytes().hex().upper()
        width = 2 * item.data.shape[1]
        separator = "#" if item.data.shape[1] <= CLASSIC_BYTES else "##1"
        lines += [
            f"({t:.6f}) can0 {name}{separator}{text[k * width : (k + 1) * width]}\n"
            for k, t in enumerate(item.time_s.tolist())
        ]
        times.append(item.time_s)
    order = np.argsort(np.concatenate([np.zeros(0), *times]), kind="stable")
    content = "".join([lines[k] for k in order]).encode("ascii")
    if path.suffix == ".gz":
        content = gzip.compress(content, compresslevel=1, mtime=0)
    write_atomically(path, content)
    return len(lines)


def _raw_codes(signal: Signal, physical: Array) -> NDArray[np.int64]:
    """Return the nearest raw code of each value, inside the valid range; for NaN the code SNA, or 0 without one.

    DatabaseError if there is a number for a floating-point signal.
    """
    named = {str(name): int(code) for code, name in (signal.choices or {}).items()}
    missing = named.get("SNA", 0)
    lowest, highest = _valid_codes(signal)
    known = np.isfinite(physical)
    if signal.is_float and known.any():
        raise DatabaseError(f"signal {signal.name} is a float; only whole-numbered signals can be written into frames")
    raw = np.rint((np.where(known, physical, 0.0) - signal.offset) / signal.scale)
    return np.where(known, np.clip(raw, lowest, highest), missing).astype(np.int64)


def _valid_codes(signal: Signal) -> tuple[int, int]:
    """Return the least and greatest raw code within the width of a signal and its range in the DBC."""
    half = 1 << (signal.length - 1)
    lowest, highest = (-half, half - 1) if signal.is_signed else (0, 2 * half - 1)
    if signal.minimum is not None and signal.maximum is not None and signal.minimum < signal.maximum:
        ends = sorted(round((limit - signal.offset) / signal.scale) for limit in (signal.minimum, signal.maximum))
        lowest, highest = max(lowest, ends[0]), min(highest, ends[1])
    return lowest, highest


def _bit_positions(signal: Signal) -> list[int]:
    """Return the position (byte * 8 + bit) of each bit of a signal, least significant first."""
    if signal.byte_order == "little_endian":
        return list(range(signal.start, signal.start + signal.length))
    positions = [signal.start]
    while len(positions) < signal.length:
        last = positions[-1]
        positions.append(last + 15 if last % 8 == 0 else last - 1)
    return positions[::-1]


def _protect(data: NDArray[np.uint8], protection: Protection) -> None:
    """Fill in counter, CRC, length and data identifier, as far as the profile has them; the first counter is 0."""
    payload = bytearray(data.shape[1])
    last = protection.modulus - 1
    for row in data:
        payload[:] = row.tobytes()
        protection.counter.put(payload, last)
        protection.advance(payload)
        last = (last + 1) % protection.modulus
        row[:] = np.frombuffer(payload, np.uint8)
