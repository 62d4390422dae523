"""Records that a node made on board (:mod:`ecu_node.summary`), read as the summaries of a store."""

from pathlib import Path

import numpy as np

from calibrator.drive import Array
from calibrator.drives.delays import BranchDelays
from calibrator.drives.store import read_onboard_record
from calibrator.errors import DriveError
from calibrator.summaries.identity import StoreIdentity
from calibrator.summaries.moments import LEVEL_EDGES_A, DriveSummary, FitSums
from calibrator.summaries.vehicle_summary import VehicleSummary, ZeroCurrent
from ecu_node.database import VehicleDatabase
from ecu_node.summary import SummaryFile, unpacked

__all__ = ["read_onboard"]


def read_onboard(
    path: Path, store: StoreIdentity, database: VehicleDatabase, *, vehicle: str, name: str
) -> VehicleSummary:
    """Read a record as a summary with the branches and inputs of a store.

    Parameters
    ----------
    path : Path
        The file.
    store : StoreIdentity
        Of the store.
    database : VehicleDatabase
        DBC and layout.
    vehicle, name : str
        Whose record it must be, and what it is called.

    Returns
    -------
    VehicleSummary
        A block for each batch of the record.

    Raises
    ------
    DriveError
        If the file is damaged, of another vehicle, layout or DBC, or lacks a branch or input of the store.
    """
    record = read_onboard_record(path, database)
    if record.vehicle != vehicle:
        raise DriveError(f"{path}: a record of vehicle {record.vehicle}; move it into the folder of its vehicle")
    if store.bank.poles:
        raise DriveError(f"{path}: made on board of plain inputs; a store with a filter bank needs the log")
    if lacking := [x for x in (*store.branches, *store.fleet_inputs) if x not in {*record.branches, *record.inputs}]:
        raise DriveError(f"{path}: no {', '.join(lacking)} in it; summarise it with branches that it has")
    try:
        summary = _summary(record, store.bank.identity)
    except (ValueError, IndexError) as error:
        raise DriveError(f"{path}: damaged: {error}; copy it again from the vehicle") from None
    delay_sd_s, zero_a, zero_sd_a = (
        np.array([missing if x is None else x for x in values])
        for values, missing in ((record.delay_sd_s, np.inf), (record.zero_offset_a, np.nan), (record.zero_sd_a, np.nan))
    )
    place = [record.branches.index(branch) for branch in store.branches]
    sd_s = delay_sd_s[place]
    return VehicleSummary(
        vehicle=vehicle,
        drives=(name,),
        summary=summary.take_branches(place, [record.inputs.index(each) for each in store.fleet_inputs]),
        delays=BranchDelays(
            branches=store.branches, delay_s=np.array(record.delay_s)[place], sd_s=sd_s, known=np.isfinite(sd_s)
        ),
        zero_current=ZeroCurrent(offset_a=zero_a[place], sd_a=zero_sd_a[place]),
    )


def _summary(record: SummaryFile, bank: str) -> DriveSummary:
    """Moments from means and covariances; ValueError or IndexError if there are too few or too many numbers."""
    B, M, K = len(record.count), len(record.inputs), len(record.branches)
    p = M + K + 1
    count, mean, covariance = np.array(record.count, np.float64), np.ones((B, p)), np.zeros((B, p, p))
    mean[:, :-1] = _numbers(record.mean, B, p - 1)
    covariance[:, :-1, :-1] = _symmetric(record.covariance, B, p - 1)
    levels, visited = np.zeros((K, len(LEVEL_EDGES_A) + 1, p + 1)), [len(chosen) for chosen in record.levels]
    sums = np.split(_numbers(record.level_sums, sum(visited), p + 1), np.cumsum(visited)[:-1])
    for k, chosen in enumerate(record.levels):
        levels[k, chosen] = sums[k]
    summary = DriveSummary(
        moments=count[:, None, None] * (covariance + mean[:, :, None] * mean[:, None, :]),
        noise_a2=_numbers(record.noise_a2, B, K),
        branches=K,
        period_s=record.period_s,
        bank=bank,
        fit=FitSums(
            levels=levels,
            fast_a2=_symmetric(record.fast_a2, B, K),
            spikes=_numbers(record.spikes, B, 2 * K).reshape(B, K, 2),
            temperature_c=_numbers(record.temperature_c, B, 1)[:, 0],
            starts=np.array(record.starts, np.bool_).reshape(B),
        ),
    )
    if not B or not (np.isfinite(summary.moments).all() and (count > 0.0).all()):
        raise ValueError("impossible numbers")
    return summary


def _symmetric(content: bytes, rows: int, size: int) -> Array:
    """Symmetric matrices of their lower triangles, shape (rows, size, size)."""
    full, lower = np.zeros((rows, size, size)), np.tril_indices(size)
    full[:, lower[0], lower[1]] = full[:, lower[1], lower[0]] = _numbers(content, rows, len(lower[0]))
    return full


def _numbers(content: bytes, rows: int, columns: int) -> Array:
    return np.array(unpacked(content), np.float64).reshape(rows, columns)
