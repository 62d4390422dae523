"""Identify one vehicle from its drive, filters and moments included, beside two subspace packages on the same data.

Vehicles, drives and noise are those of :mod:`bench.dynamic_vehicles`: 12,000 samples, three inputs,
four branches, order 6, poles within 15 % of the fleet's. The bank is chosen from other vehicles of the fleet, once. The
slope error is that of the simulated current on a common unity drive over the true, noise-free one, |slope - 1|; the
simulation is compared with it too. One thread.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

import numpy as np
import pandas as pd
from nfoursid.nfoursid import NFourSID
from sippy_unipi import system_identification
from threadpoolctl import threadpool_limits

from bench.dynamic_vehicles import PERIOD_S, DynamicVehicle, bank_model, drive_inputs, recorded
from calibrator.drive import Array
from calibrator.drives.align import Samples
from calibrator.estimator.fleet_identification import choose_filter_bank, held_out_snr_db, read_outs
from calibrator.published.state_space import StateSpaceModel, simulation_snr_db
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.summariser import summarise_samples

sys.path.insert(0, str(Path(__file__).parents[1]))  # run as a script, the tools are not found otherwise
from bench.row import Row

__all__ = ["main", "rows"]

ORDER = 6
"""Of the vehicles; the other packages are told. [1]"""
BLOCK_ROWS = 10
"""Past and future samples that nfoursid sees: as many as the subspace step of this project. [1]"""
COMPARED_DB = 20.0
"""Signal-to-noise ratio of the currents that all identify. [dB]"""
OTHER_DB = (30.0, 40.0)
POOL = range(100, 108)
"""Vehicles that the bank is chosen from; none of them is identified."""
UNITY = 999
LEAD_IN = 600
"""Samples of the unity drive by which the states settle."""
REPETITIONS = 15
"""Of what takes milliseconds; the median counts."""

Identify = Callable[[Samples], StateSpaceModel]


@dataclass(frozen=True, kw_only=True)
class _Result:
    """Median time per vehicle, 95th percentile of the slope errors [1], and worst channel of each vehicle [dB]."""

    time_s: float
    slope_error: float
    worst_db: Array


def rows(*, quick: bool) -> list[Row]:
    """Measure.

    Parameters
    ----------
    quick : bool
        Two vehicles instead of five, and ten instead of forty where no package takes part.

    Returns
    -------
    list of Row
        Times, slope errors and simulation errors.
    """
    with threadpool_limits(1):
        bank, vehicles = _fleet(COMPARED_DB, 2 if quick else 5)
        ours = _measure(lambda drive: bank_model(bank, drive), vehicles, REPETITIONS)
        peers = {
            f"nfoursid {version('nfoursid')}": _measure(_nfoursid, vehicles, 1),
            f"sippy {version('sippy-unipi')} N4SID": _measure(_sippy, vehicles, 1),
        }
        alone = [_alone(snr_db, 10 if quick else 40) for snr_db in (COMPARED_DB, *OTHER_DB)]
    compared = [row for name, peer in peers.items() for row in _compared(ours, name, peer)]
    return [*compared, *_parts(bank, vehicles[0].samples), *(row for rows in alone for row in rows)]


def main() -> None:
    """Print one line per figure."""
    for row in rows(quick="--quick" in sys.argv[1:]):
        beside = f"  {row.peer}" if row.peer else ""
        ratio = f"  {row.ratio:.3g} times better" if row.ratio is not None else ""
        print(f"{row.name:62s} {row.value:9.3f} {row.unit:3s}{beside}{ratio}")


def _fleet(snr_db: float, count: int) -> tuple[FilterBank, list[DynamicVehicle]]:
    pool = [[recorded(number, snr_db=snr_db).samples] for number in POOL]
    return choose_filter_bank(pool, period_s=PERIOD_S), [recorded(number, snr_db=snr_db) for number in range(count)]


def _measure(identify: Identify, vehicles: Sequence[DynamicVehicle], repetitions: int) -> _Result:
    unity, times, slopes, worst = drive_inputs(UNITY), [], [], []
    for vehicle in vehicles:
        for _ in range(repetitions):
            start = perf_counter()
            model = identify(vehicle.samples)
            times.append(perf_counter() - start)
        true, simulated = (each.simulate(unity)[LEAD_IN:] for each in (vehicle.model, model))
        centred = true - true.mean(axis=0)
        slopes.append(np.sum(centred * simulated, axis=0) / np.sum(centred**2, axis=0))
        worst.append(simulation_snr_db(true, simulated).min())
    error = float(np.percentile(np.abs(np.array(slopes) - 1.0), 95))
    return _Result(time_s=float(np.median(times)), slope_error=error, worst_db=np.array(worst))


def _compared(ours: _Result, name: str, peer: _Result) -> list[Row]:
    what = f"SNR {COMPARED_DB:.0f}"
    return [
        Row(
            name="identify a vehicle of 12,000 samples, moments included",
            value=1e3 * ours.time_s,
            unit="ms",
            peer=f"{name}: {1e3 * peer.time_s:.0f} ms",
            ratio=peer.time_s / ours.time_s,
        ),
        Row(
            name=f"slope error at {what}, 95th percentile",
            value=100.0 * ours.slope_error,
            unit="%",
            peer=f"{name}: {100.0 * peer.slope_error:.2f} %",
            ratio=peer.slope_error / ours.slope_error,
        ),
        Row(
            name=f"worst channel at {what}, median vehicle",
            value=float(np.median(ours.worst_db)),
            unit="dB",
            peer=f"{name}: {np.median(peer.worst_db):.1f} dB",
        ),
    ]


def _parts(bank: FilterBank, drive: Samples) -> list[Row]:
    """Where the time goes, by the median of repetitions."""
    batch = [summarise_samples([drive], period_s=PERIOD_S, bank=bank)] * 100
    moments, branches = np.stack([summary.total for summary in batch]), batch[0].branches
    names = ("of it filters and moments", "of it read-out and its judgement, a vehicle of 100 at once")
    times_s = (
        _median_s(lambda: summarise_samples([drive], period_s=PERIOD_S, bank=bank)),
        _median_s(lambda: (read_outs(moments, branches), held_out_snr_db(batch))) / len(batch),
    )
    parts = [Row(name=name, value=1e3 * s, unit="ms") for name, s in zip(names, times_s, strict=True)]
    return [*parts, Row(name="columns of the bank", value=float(bank.width), unit="1")]


def _median_s(action: Callable[[], object]) -> float:
    times = []
    for _ in range(REPETITIONS):
        start = perf_counter()
        action()
        times.append(perf_counter() - start)
    return float(np.median(times))


def _alone(snr_db: float, count: int) -> list[Row]:
    """What more vehicles than the packages have time for say, at one noise."""
    bank, vehicles = _fleet(snr_db, count)
    found = _measure(lambda drive: bank_model(bank, drive), vehicles, 1)
    what = f"SNR {snr_db:.0f}, {count} vehicles"
    return [
        Row(name=f"slope error at {what}, 95th percentile", value=100.0 * found.slope_error, unit="%"),
        Row(name=f"worst channel at {what}, median vehicle", value=float(np.median(found.worst_db)), unit="dB"),
        Row(name=f"worst channel at {what}, 5th percentile", value=float(np.percentile(found.worst_db, 5)), unit="dB"),
        Row(name=f"worst channel at {what}, worst vehicle", value=float(found.worst_db.min()), unit="dB"),
    ]


def _nfoursid(drive: Samples) -> StateSpaceModel:
    u, y = _centred(drive)
    names = [f"u{m}" for m in range(u.shape[1])], [f"y{k}" for k in range(y.shape[1])]
    frame = pd.DataFrame(np.hstack([u, y]), columns=[*names[0], *names[1]])
    search = NFourSID(frame, output_columns=names[1], input_columns=names[0], num_block_rows=BLOCK_ROWS)
    search.subspace_identification()
    found, _ = search.system_identification(rank=ORDER)
    return _with_offset(drive, (found.a, found.b, found.c, found.d))


def _sippy(drive: Samples) -> StateSpaceModel:
    u, y = _centred(drive)
    found = system_identification(y.T, u.T, "N4SID", SS_fixed_order=ORDER, SS_D_required=True)
    return _with_offset(drive, (found.A, found.B, found.C, found.D))


def _centred(drive: Samples) -> tuple[Array, Array]:
    """Neither package knows of an offset."""
    return drive.inputs - drive.inputs.mean(axis=0), drive.currents_a - drive.currents_a.mean(axis=0)


def _with_offset(drive: Samples, matrices: tuple[Array, Array, Array, Array]) -> StateSpaceModel:
    """Model whose steady state at the mean inputs are the mean currents."""
    A, B, C, D = (np.asarray(matrix, np.float64) for matrix in matrices)
    gain = D + C @ np.linalg.solve(np.eye(len(A)) - A, B)
    offset_a = drive.currents_a.mean(axis=0) - gain @ drive.inputs.mean(axis=0)
    return StateSpaceModel(A=A, B=B, C=C, D=D, x0=np.zeros(len(A)), offset_a=offset_a, snr_db=np.full(len(C), np.nan))


if __name__ == "__main__":
    main()
