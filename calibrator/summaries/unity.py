"""Unity window of a store: a minute of one vehicle's inputs on which every vehicle of the fleet can be looked at.

Summaries are moments and hold no time; the window is what a picture needs beside them. It is kept in
``STORE/unity.parquet``, one row per instant with the columns of the store's filter bank, chosen where the branch
currents vary most.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from calibrator.drive import Array, Drive, DriveFile, Mask
from calibrator.drives.align import align
from calibrator.errors import FleetError
from calibrator.processes.messages import Unread
from calibrator.processes.reading import read_in_processes
from calibrator.sources.fleet_source import FleetSource, load_drive
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.identity import StoreIdentity
from calibrator.summaries.store import SummaryStore
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError

__all__ = ["UNITY_FILE", "WINDOW_S", "UnityWindow", "decode_window", "keep_unity_window", "liveliest_window"]

UNITY_FILE = "unity.parquet"
WINDOW_S = 60.0
"""Length of the window: an acceleration, a recuperation and some rest fit in. [s]"""
LEAST_VALID = 0.95
"""Share of its instants that must be valid. [1]"""
MOST_TRIED = 4
"""Vehicles that are looked at for a window; the first that has one gives it."""
VOLTAGE_UNITS = {"V": 1.0, "kV": 1000.0}
HIGH_VOLTAGE_V = (60.0, 2000.0)
"""Between protective low voltage and the highest class of road vehicles. [V]"""


@dataclass(frozen=True, kw_only=True)
class UnityWindow:
    """Inputs of one vehicle over a short time.

    Attributes
    ----------
    vehicle, drive : str
        Where it was taken from.
    time_s : ndarray of shape (T,)
        Instants from 0. [s]
    columns : ndarray of shape (T, W)
        Columns of the filter bank; NaN where not valid.
    voltage_v : float or None
        Median voltage of the junction in it; None if no input tells it. [V]
    bank : FilterBank
        Whose columns these are.
    """

    vehicle: str
    drive: str
    time_s: Array
    columns: Array
    voltage_v: float | None
    bank: FilterBank

    def encoded(self) -> bytes:
        """Return the content of the file."""
        about = {
            b"vehicle": self.vehicle,
            b"drive": self.drive,
            b"voltage_v": f"{self.voltage_v or ''}",
            b"bank": msgspec.json.encode(self.bank),
        }
        table = pa.table(
            {"time_s": self.time_s, **{f"column_{k}": values for k, values in enumerate(self.columns.T)}}
        ).replace_schema_metadata(about)
        buffer = io.BytesIO()
        pq.write_table(table, buffer, compression="zstd")
        return buffer.getvalue()


def decode_window(content: bytes, where: str) -> UnityWindow:
    """Read a unity window.

    Parameters
    ----------
    content : bytes
        Of the file.
    where : str
        Its name, for messages.

    Returns
    -------
    UnityWindow
        As it was written.

    Raises
    ------
    FleetError
        If it is none.
    """
    try:
        table = pq.ParquetFile(io.BytesIO(content)).read(use_threads=False)
        about = table.schema.metadata
        voltage = about[b"voltage_v"].decode()
        return UnityWindow(
            vehicle=about[b"vehicle"].decode(),
            drive=about[b"drive"].decode(),
            time_s=table["time_s"].to_numpy(),
            columns=np.column_stack([table[name].to_numpy() for name in table.column_names[1:]]),
            voltage_v=float(voltage) if voltage else None,
            bank=msgspec.json.decode(about[b"bank"], type=FilterBank),
        )
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError, msgspec.MsgspecError) as error:
        reason = str(error).partition("\n")[0][:120]
        raise FleetError(
            f"{where}: damaged unity window: {reason}; remove it, and summarise or calibrate again"
        ) from None


def keep_unity_window(
    store: SummaryStore, fleet: FleetSource, database: VehicleDatabase, *, time_limit_s: float
) -> None:
    """Choose a window from the first vehicles and put it into the store, unless there is one.

    Parameters
    ----------
    store : SummaryStore
        Whose filter bank makes the columns.
    fleet : FleetSource
        The drives.
    database : VehicleDatabase
        DBC and layout.
    time_limit_s : float
        Longest time for the drives of one vehicle. [s]
    """
    if store.storage.read_if_there(UNITY_FILE) is not None:
        return
    entries = [fleet.vehicles[name] for name in sorted(fleet.vehicles)[:MOST_TRIED]]
    choose = partial(_window_of, identity=store.identity, database=database)
    for found in read_in_processes(choose, entries, workers=1, limit_s=time_limit_s):
        if isinstance(found, UnityWindow):
            store.storage.write(UNITY_FILE, found.encoded())
            return


def _window_of(
    entries: Sequence[DriveFile], *, identity: StoreIdentity, database: VehicleDatabase
) -> UnityWindow | Unread:
    """Window of the vehicle's first drive that has one."""
    for entry in entries:
        try:
            drive = load_drive(entry, database)
            samples = align(drive, database.layout, identity.branches, inputs=identity.fleet_inputs)
        except (UserError, ArithmeticError, LookupError, ValueError):  # a picture is no reason to end a run
            continue
        if samples.input_names != identity.bank.input_names:
            continue
        period_s = database.layout.period_s
        columns, used = identity.bank.run(samples.inputs, samples.valid, identity.bank.start())
        start = liveliest_window(samples.currents_a, used & samples.valid, round(WINDOW_S / period_s))
        if start is None:
            continue
        window = slice(start, start + round(WINDOW_S / period_s))
        valid = (used & samples.valid)[window]
        return UnityWindow(
            vehicle=entry.vehicle,
            drive=entry.name,
            time_s=samples.time_s[window] - samples.time_s[start],
            columns=np.where(valid[:, None], columns[window], np.nan),
            voltage_v=_voltage_v(drive, database, first_s=samples.time_s[start], length_s=WINDOW_S),
            bank=identity.bank,
        )
    return Unread(reason="no window of its drives is valid throughout")


def liveliest_window(currents_a: Array, valid: Mask, length: int) -> int | None:
    """Find the window in which the currents vary most.

    Parameters
    ----------
    currents_a : ndarray of shape (T, K)
        Branch currents. [A]
    valid : ndarray of bool, shape (T,)
        Instants that may be used.
    length : int
        Instants of a window.

    Returns
    -------
    int or None
        Its first instant; None if no window has :data:`LEAST_VALID` of its instants valid.
    """
    if len(valid) < length:
        return None
    used = np.where(valid[:, None], currents_a, 0.0)
    sums = np.cumsum(np.column_stack([used, used**2, valid]), axis=0)
    sums = np.vstack([np.zeros(sums.shape[1]), sums])
    inside = sums[length:] - sums[:-length]
    count, K = inside[:, -1], currents_a.shape[1]
    enough = count >= LEAST_VALID * length
    if not enough.any():
        return None
    samples = np.maximum(count, 1.0)[:, None]
    variance = (inside[:, K : 2 * K] / samples - (inside[:, :K] / samples) ** 2).sum(axis=1)
    return int(np.argmax(np.where(enough, variance, -1.0)))


def _voltage_v(drive: Drive, database: VehicleDatabase, *, first_s: float, length_s: float) -> float | None:
    """Median in the window of the one recorded input that is a high voltage; None if there is none, or several."""
    found = []
    for item in database.layout.input:
        unit, channel = database.signal(item.signal)[1].unit or "", drive.inputs.get(item.name)
        if unit not in VOLTAGE_UNITS or channel is None:
            continue
        inside = channel.good & (channel.time_s >= first_s) & (channel.time_s <= first_s + length_s)
        if inside.any():
            median_v = VOLTAGE_UNITS[unit] * float(np.median(channel.value[inside]))
            found += [median_v] if HIGH_VOLTAGE_V[0] <= median_v <= HIGH_VOLTAGE_V[1] else []
    return found[0] if len(found) == 1 else None
