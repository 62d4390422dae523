"""What the page of a fleet holds of single vehicles: columns for the table, and evidence while there is room."""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrator.drive import Array
from calibrator.estimator.vehicle_report import explanation_text
from calibrator.report.evidence_columns import Evidence
from calibrator.report.fleet_table import FleetTable
from calibrator.report.packing import Packed, as_text, pack

__all__ = [
    "Details",
    "columns_within",
    "details_within",
    "kinds_of",
    "most_to_say_first",
    "row_steps",
]

DURATION_STEP_S = 0.1
GAIN_STEP, CURRENT_STEP_A, SHARE_STEP = 1e-5, 1e-3, 1e-5
"""What columns are rounded to: a thousandth of a percent, a milliampere; of probabilities as of gains. [1], [A]"""


def most_to_say_first(table: FleetTable) -> NDArray[np.int64]:
    """Vehicles with a suspicion, a question or a fault before those without, the largest faults first."""
    plain = (table.verdict == "no sensor fault") & ~table.suspected
    return np.lexsort((-table.error_a.max(axis=1), plain))


def _vehicle_columns(table: FleetTable, beside: FleetTable | None, listed: NDArray[np.int64]) -> Packed:
    """Columns of the vehicles that are listed."""
    columns: dict[str, tuple[Array, float]] = {
        "verdict": (_codes(table.verdict, kinds_of(table.verdict)), 1.0),
        "suspected": (table.suspected.astype(np.float64), 1.0),
        "corrected": (table.corrected.astype(np.float64), 1.0),
        "confidence": (table.confidence, SHARE_STEP),
        "hardware_probability": (table.hardware_probability, SHARE_STEP),
        "hardware_drift": (table.hardware_drift, GAIN_STEP),
        "measured_a": (table.measured_a, CURRENT_STEP_A),
        "deployed_a": (table.deployed_a, CURRENT_STEP_A),
        "duration_s": (table.duration_s, DURATION_STEP_S),
        "drift": (table.drift, GAIN_STEP),
        "drift_sd": (table.drift_sd, GAIN_STEP),
        "offset_a": (table.offset_a, CURRENT_STEP_A),
        "offset_sd_a": (table.offset_sd_a, CURRENT_STEP_A),
        "fault_probability": (table.fault_probability, SHARE_STEP),
        "harm_probability": (table.harm_probability, SHARE_STEP),
        "applied": (table.applied.astype(np.float64), 1.0),
        "held_back": (_codes(table.held_back, kinds_of(table.held_back)), 1.0),
    }
    if beside is not None:
        place = beside.places(table.vehicle.tolist())
        columns |= {
            "beside_a": (_at(beside.deployed_a, place), CURRENT_STEP_A),
            "beside_drift": (_at(beside.drift, place), GAIN_STEP),
            "beside_offset_a": (_at(beside.offset_a, place), CURRENT_STEP_A),
        }
    return pack({name: (values[listed], step) for name, (values, step) in columns.items()})


def columns_within(
    table: FleetTable, beside: FleetTable | None, order: NDArray[np.int64], room: int
) -> tuple[NDArray[np.int64], Packed]:
    """Columns of as many vehicles as there is room for.

    Parameters
    ----------
    table, beside : FleetTable, FleetTable or None
        The result, and that of another method.
    order : ndarray of int of shape (n,)
        Vehicles, those with most to say first.
    room : int
        For so much text. [byte]

    Returns
    -------
    listed : ndarray of int
        The first of them.
    packed : Packed
        Their columns.
    """
    listed = order
    while True:
        packed = _vehicle_columns(table, beside, listed)
        if len(packed.data) <= room or not len(listed):
            return listed, packed
        listed = listed[: int(len(listed) * min(room / len(packed.data), 0.95))]


def _at(values: Array, place: NDArray[np.int64]) -> Array:
    """Values of vehicles at some places; not known where there is none."""
    found = values[np.maximum(place, 0)].copy() if len(values) else np.full((len(place), *values.shape[1:]), np.nan)
    found[place < 0] = np.nan
    return found


def kinds_of(texts: NDArray[np.object_]) -> list[str]:
    """Different texts, the most frequent first."""
    found, counts = np.unique([text for text in texts.ravel() if text is not None], return_counts=True)
    return [str(text) for text in found[np.argsort(-counts, kind="stable")]]


def _codes(texts: NDArray[np.object_], kinds: Sequence[str]) -> Array:
    """Number of each text among the kinds, not a number for none."""
    code = {kind: float(number) for number, kind in enumerate(kinds)}
    return np.array([code.get(text, np.nan) for text in texts.ravel()]).reshape(texts.shape)


TRIED = 4000
"""Vehicles whose details tell how much room those of others need."""


@dataclass(frozen=True, kw_only=True)
class Details:
    """Evidence and explanations of the first vehicles that are listed.

    Attributes
    ----------
    told : int
        How many these are.
    texts : str
        Base64 of gzip of JSON: explanations, and what would decide.
    evidence : Packed
        Columns.
    """

    told: int
    texts: str
    evidence: Packed


def details_within(reasons: NDArray[np.object_], evidence: Evidence, room: int) -> Details:
    """Details of as many vehicles as there is room for.

    Parameters
    ----------
    reasons : ndarray of str of shape (n,)
        What would decide on each vehicle that is listed, in the order of the page.
    evidence : Evidence
        Of the same.
    room : int
        For so much text. [byte]

    Returns
    -------
    Details
        Of the first of them.
    """
    told = len(reasons)
    if told > TRIED:
        tried = _details(reasons, evidence, TRIED)
        told = min(told, int(0.98 * TRIED * max(room, 0) / max(_size(tried), 1)))
    while True:
        details = _details(reasons, evidence, told)
        size = _size(details)
        if size <= room or not told:
            return details
        told = int(told * min(max(room, 0) / size, 0.95))


def _size(details: Details) -> int:
    return len(details.texts) + len(details.evidence.data)


def row_steps(evidence: Evidence) -> Array:
    """What each row of the evidence is rounded to, shape (R,). [1], [A]"""
    return np.where(np.arange(len(evidence.names)) < evidence.ratios, GAIN_STEP, CURRENT_STEP_A)


def _details(reasons: NDArray[np.object_], found: Evidence, told: int) -> Details:
    texts = {
        "explanations": [
            [[round(each.probability, 4), explanation_text(each)] for each in rivals]
            for rivals in found.explanations[:told]
        ],
        "reasons": reasons[:told].tolist(),
    }
    rows = {"value": found.value, "sd": found.sd, "explained": found.explained}
    packed = pack({name: (values[:told] / row_steps(found), 1.0) for name, values in rows.items()})
    return Details(told=told, texts=as_text(msgspec.json.encode(texts)), evidence=packed)
