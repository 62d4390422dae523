"""The filter bank of a fleet, chosen by how well it simulates what it was not fitted on.

Candidates are the plain inputs; low-passes whose time constants are spaced evenly in their logarithm; and the poles of
systems of several orders, identified from some vehicles together (their second moments of lagged data are added, which
is what one subspace identification of all of them sees), as they are, and with several poles about each, which follow
vehicles whose own is a little off. Each candidate's read-outs are fitted to each vehicle, and judged on held-out blocks
that are the same for all; of those that are about as good as the best, the smallest is taken.
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import reduce
from operator import add

import numpy as np

from calibrator.drive import Array, Complex
from calibrator.drives.align import Samples
from calibrator.errors import DriveError
from calibrator.identification.identify import observability, standardised_moments, subspace_modes
from calibrator.identification.read_out import fit_read_outs
from calibrator.summaries.filter_bank import FilterBank, Poles, low_passes
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import Summariser
from calibrator.terminal.progress import shown

__all__ = ["pooled_bank"]

ORDERS = (1, 2, 3, 4, 5, 6, 8)
"""Of the pooled systems: a power train as seen at 10 Hz has few modes. [1]"""
LOW_PASSES = (1, 2, 4, 6)
"""Numbers of evenly spaced low-passes. [1]"""
SHORTEST_S, LONGEST_S = 0.05, 20.0
"""Time constants of poles: faster ones are as good as none at 10 Hz, slower ones settle longer than drives last. [s]"""
SPLITS = (
    ((1.0,), (1.0,)),
    ((1.0 / 1.3, 1.3), (1.0 / 1.2, 1.0, 1.2)),
    ((1.0 / 1.15, 1.0, 1.15), (1.0 / 1.15, 1.0, 1.15)),
)
"""Factors on the rates of a real pole and of a resonance, that stand in its place: as it is, and as follows vehicles
whose poles are within 15 % of the fleet's. [1]"""
TOLERANCE_DB = 0.003
"""A bank is large enough if its simulation error, noise included, is this close to the best: at a signal-to-noise
ratio of 20 dB a misfit of -52 dB. [dB]"""
TINY = 1e-12
"""Power of an error, over that of the signal, that counts as none. [1]"""


def pooled_bank(vehicles: Sequence[Sequence[Samples]], *, period_s: float) -> FilterBank:
    """Choose the bank for a fleet from some of its vehicles.

    Parameters
    ----------
    vehicles : sequence of sequence of Samples
        Aligned drives of each vehicle, with the same inputs and branches.
    period_s : float
        Distance of the samples. [s]

    Returns
    -------
    FilterBank
        Of the inputs of the drives.

    Raises
    ------
    DriveError
        If no vehicle has three blocks of valid samples, so that no block could be held out.
    """
    names = vehicles[0][0].input_names
    candidates = [
        FilterBank(input_names=names, period_s=period_s, poles=poles)
        for poles in dict.fromkeys(_candidates(vehicles, period_s))
    ]
    settling = max(bank.settling for bank in candidates)
    errors = [
        _error_db(bank, vehicles, settling) for bank in shown(candidates, "try filter banks", len(candidates), "banks")
    ]
    if not np.isfinite(errors).any():
        raise DriveError(
            f"none of {len(vehicles)} vehicles has three blocks of varied, valid samples to choose a filter bank by, "
            f"{settling * period_s:.0f} s after a start or a gap; give a bank, or record longer drives"
        )
    good = [bank for bank, error in zip(candidates, errors, strict=True) if error <= min(errors) + TOLERANCE_DB]
    return min(good, key=lambda bank: bank.width)


def _candidates(vehicles: Sequence[Sequence[Samples]], period_s: float) -> Iterator[Poles]:
    """Sets of poles, from the smallest on."""
    yield ()
    for count in LOW_PASSES:
        yield low_passes(np.geomspace(LONGEST_S, 2.0 * period_s, count + 2)[1:-1], period_s=period_s)
    for poles in _pooled_poles(vehicles, period_s):
        for of_real, of_resonance in SPLITS:
            yield _as_pairs([pole**f for pole in poles for f in (of_resonance if pole.imag > 0.0 else of_real)])


def _pooled_poles(vehicles: Sequence[Sequence[Samples]], period_s: float) -> Iterator[Complex]:
    """Poles of systems of several orders; none if the vehicles have too little data, or inputs that tell nothing."""
    drives = [drive for vehicle in vehicles for drive in vehicle if drive.valid.any()]
    if not drives:
        return
    M, K = drives[0].inputs.shape[1], drives[0].currents_a.shape[1]
    moments = reduce(add, (standardised_moments(drive.inputs, drive.currents_a, drive.valid) for drive in drives))
    try:
        observed = observability(moments, inputs=M)
    except (DriveError, np.linalg.LinAlgError):
        return
    for order in ORDERS:
        yield _bounded(subspace_modes(observed, K, order).poles, period_s)


def _bounded(poles: Complex, period_s: float) -> Complex:
    """Poles without those that are too fast, or real and alternating; those that are too slow become faster."""
    radius = np.abs(poles)
    kept = (radius >= np.exp(-period_s / SHORTEST_S)) & ((poles.imag > 0.0) | (poles.real > 0.0))
    slowest = np.exp(-period_s / LONGEST_S)
    return np.asarray((poles * np.minimum(1.0, slowest / np.maximum(radius, slowest)))[kept])


def _as_pairs(poles: Iterable[complex]) -> Poles:
    """Poles as a bank has them; a split may turn one beyond the highest frequency, where its mirror image stands."""
    return tuple(sorted(((float(pole.real), float(abs(pole.imag))) for pole in poles), reverse=True))


def _error_db(bank: FilterBank, vehicles: Sequence[Sequence[Samples]], settling: int) -> float:
    """Mean over vehicles and branches of the power of the simulation error on held-out blocks, over the signal's."""
    snr_db = []
    for drives in vehicles:
        try:
            snr_db.append(fit_read_outs([_summary(bank, drives, settling)]).snr_db[0])
        except DriveError:
            continue
    values: Array = np.concatenate([np.zeros(0), *snr_db])
    ratio = 10.0 ** (-values[np.isfinite(values)] / 10.0)
    return float(np.mean(10.0 * np.log10(ratio + TINY))) if ratio.size else np.inf


def _summary(bank: FilterBank, drives: Sequence[Samples], settling: int) -> DriveSummary:
    summariser = Summariser(bank, branches=drives[0].currents_a.shape[1], settling=settling)
    for drive in drives:
        summariser.add(drive.inputs, drive.currents_a, drive.valid)
        summariser.end_drive()
    return summariser.summary()
