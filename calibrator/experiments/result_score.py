"""Score of a result against the truth of its artificial fleet, for ``calibrator score``."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibrator.drive import Array, Mask
from calibrator.drives.fleet_id import require_same_fleet
from calibrator.errors import FleetError
from calibrator.estimator.results import RunRecord, read_results, read_run
from calibrator.faults import Faults
from calibrator.fleet_truth import FleetTruth, faults_of, read_truth
from calibrator.score import f2_score, harmed, recovered
from calibrator.terminal.text import dumps, table

__all__ = ["FleetScore", "score_result"]

WIDE_TOLERANCE = 0.25
"""The wider of the two relative errors that the paper's table 2 gives. [1]"""


@dataclass(frozen=True, kw_only=True)
class FleetScore:
    """How good a result is.

    Attributes
    ----------
    vehicles, left_out : int
        Vehicles of the truth, and how many of them have no parameters; these count as not recovered.
    recovery_rate, recovery_rate_25 : float
        Share of the vehicles whose sensor faults were found within 10 % and 25 %.
    harmed_rate : float
        Share of the vehicles of which any branch is farther from the truth after correction, on an unseen drive.
    deployed_rate : float
        Share of the vehicles with parameters that the node applies.
    hardware_f2 : float
        f2 score of the hardware suspicion.
    """

    vehicles: int
    left_out: int
    recovery_rate: float
    recovery_rate_25: float
    harmed_rate: float
    deployed_rate: float
    hardware_f2: float

    def as_json(self) -> str:
        """The score as JSON."""
        return dumps(asdict(self))

    def as_text(self) -> str:
        """The score for people."""
        rows = [
            ("vehicles", f"{self.vehicles}"),
            ("left out", f"{self.left_out}"),
            ("recovered within 10 %", f"{self.recovery_rate:.3f}"),
            ("recovered within 25 %", f"{self.recovery_rate_25:.3f}"),
            ("harmed, of all vehicles", f"{self.harmed_rate:.3f}"),
            ("with parameters to apply", f"{self.deployed_rate:.3f}"),
            ("f2 of the hardware suspicion", f"{self.hardware_f2:.3f}"),
        ]
        return table(("share of vehicles", ""), rows)


def score_result(result: Path, truth_file: Path) -> FleetScore:
    """Compare ``RESULT/results.parquet`` with ``truth.json``.

    Parameters
    ----------
    result : Path
        Folder that ``calibrator calibrate`` wrote.
    truth_file : Path
        File that ``calibrator simulate`` wrote.

    Returns
    -------
    FleetScore
        The score.

    Raises
    ------
    FleetError
        If one of them cannot be read, or they are of different fleets or branches.
    """
    truth = read_truth(truth_file)
    _check_run(read_run(result), truth, result, truth_file)
    rows = {(row["vehicle"], row["branch"]): row for row in read_results(result) if row["branch"] is not None}
    names = list(truth.vehicles)
    known = [name for name in names if (name, truth.branches[0]) in rows]
    _check(rows, truth, known, result)
    estimate = _estimate(rows, truth, known)
    actual = faults_of(truth, known)
    applied = _column(rows, truth, known, "applied").astype(bool)
    deployed = Faults(
        hardware_drift=estimate.hardware_drift,
        hardware_offset_a=estimate.hardware_offset_a,
        drift=np.where(applied, estimate.drift, 0.0),
        offset_a=np.where(applied, estimate.offset_a, 0.0),
    )
    suspected = _column(rows, truth, known, "hardware_fault")[:, 0].astype(bool)
    moments = {
        "mean_a": _moments(truth, known, "unseen_mean_a"),
        "mean_square_a2": _moments(truth, known, "unseen_mean_square_a2"),
    }

    def share(mask: Mask) -> float:
        return float(np.sum(mask)) / len(names)

    def found(tolerance: float) -> float:
        return share(
            recovered(
                estimate,
                actual,
                full_scale_a=truth.full_scale_a,
                smallest_fault=truth.magnitude[0],
                tolerance=tolerance,
            )
        )

    return FleetScore(
        vehicles=len(names),
        left_out=len(names) - len(known),
        recovery_rate=found(0.10),
        recovery_rate_25=found(WIDE_TOLERANCE),
        harmed_rate=share(harmed(deployed, actual, **moments)),
        deployed_rate=share(np.asarray(applied.any(axis=1))),
        hardware_f2=f2_score(suspected, actual.has_hardware_fault),
    )


def _check_run(run: RunRecord, truth: FleetTruth, result: Path, truth_file: Path) -> None:
    require_same_fleet(run.fleet_ids, truth.fleet_id, drives=result, truth=truth_file)
    if (run.layout, set(run.branches)) != (truth.layout, set(truth.branches)):
        raise FleetError(
            f"{result}: of layout {run.layout} with branches {', '.join(run.branches)}, the truth of layout "
            f"{truth.layout} with branches {', '.join(truth.branches)}; calibrate with the branches of the truth"
        )


def _check(rows: dict[tuple[str, str], dict[str, Any]], truth: FleetTruth, known: list[str], result: Path) -> None:
    strangers = sorted({vehicle for vehicle, _ in rows} - truth.vehicles.keys())
    if strangers or not known:
        raise FleetError(
            f"{result}: vehicles {', '.join(strangers[:5]) or 'none'} are not in the truth; "
            "is it the truth of another fleet?"
        )


def _column(rows: dict[tuple[str, str], dict[str, Any]], truth: FleetTruth, known: list[str], name: str) -> Array:
    return np.array([[rows[vehicle, branch][name] for branch in truth.branches] for vehicle in known], dtype=float)


def _estimate(rows: dict[tuple[str, str], dict[str, Any]], truth: FleetTruth, known: list[str]) -> Faults:
    return Faults(
        hardware_drift=_column(rows, truth, known, "hardware_drift")[:, 0],
        hardware_offset_a=_column(rows, truth, known, "hardware_offset_a"),
        drift=_column(rows, truth, known, "drift"),
        offset_a=_column(rows, truth, known, "offset_a"),
    )


def _moments(truth: FleetTruth, known: list[str], field: str) -> Array:
    return np.array(
        [[getattr(truth.vehicles[vehicle], field)[branch] for branch in truth.branches] for vehicle in known]
    )
