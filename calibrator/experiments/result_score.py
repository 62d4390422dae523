"""Score of a result against the truth of its artificial fleet, for ``calibrator score``."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from calibrator.drive import Array, Mask
from calibrator.drives.fleet_id import require_same_fleet
from calibrator.errors import FleetError
from calibrator.estimator.results import read_results, read_run
from calibrator.faults import Faults
from calibrator.fleet_truth import faults_of, read_truth
from calibrator.score import f2_score, harmed, recovered
from calibrator.terminal.text import dumps, table

__all__ = ["FleetScore", "score_result"]

WORDS = {
    "vehicles": "vehicles",
    "left_out": "left out",
    "recovery_rate": "recovered within 10 %",
    "recovery_rate_25": "recovered within 25 %",
    "harmed_rate": "harmed, of all vehicles",
    "deployed_rate": "with parameters to apply",
    "hardware_f2": "f2 of the hardware suspicion",
}


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
            (WORDS[name], f"{value:.3f}" if isinstance(value, float) else f"{value}")
            for name, value in asdict(self).items()
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
    truth, run = read_truth(truth_file), read_run(result)
    require_same_fleet(run.fleet_ids, truth.fleet_id, drives=result, truth=truth_file)
    if (run.layout, set(run.branches)) != (truth.layout, set(truth.branches)):
        raise FleetError(
            f"{result}: of layout {run.layout} with branches {', '.join(run.branches)}, the truth of layout "
            f"{truth.layout} with branches {', '.join(truth.branches)}; calibrate with the branches of the truth"
        )
    rows = pd.DataFrame(read_results(result)).dropna(subset="branch").set_index(["vehicle", "branch"])
    there = set(rows.index.get_level_values("vehicle"))
    strangers, known = sorted(there - truth.vehicles.keys()), [name for name in truth.vehicles if name in there]
    if strangers or not known:
        raise FleetError(
            f"{result}: vehicles {', '.join(strangers[:5]) or 'none'} are not in the truth; "
            "is it the truth of another fleet?"
        )

    def column(name: str) -> Array:
        """A column of the result, shape (N, K)."""
        table = rows[name].unstack("branch").loc[known, truth.branches]
        return np.asarray(table.to_numpy(dtype=float))

    def moment(field: str) -> Array:
        """Moments of the true currents, shape (N, K)."""
        return np.array([[getattr(truth.vehicles[name], field)[b] for b in truth.branches] for name in known])

    def share(mask: Mask) -> float:
        return float(np.sum(mask)) / len(truth.vehicles)

    drift, offset_a, actual = column("drift"), column("offset_a"), faults_of(truth, known)
    hardware = {"hardware_drift": column("hardware_drift")[:, 0], "hardware_offset_a": column("hardware_offset_a")}
    estimate = Faults(**hardware, drift=drift, offset_a=offset_a)
    applied = column("applied").astype(bool)
    deployed = Faults(**hardware, drift=np.where(applied, drift, 0.0), offset_a=np.where(applied, offset_a, 0.0))
    within_10, within_25 = (
        recovered(
            estimate, actual, full_scale_a=truth.full_scale_a, smallest_fault=truth.magnitude[0], tolerance=tolerance
        )
        for tolerance in (0.10, 0.25)  # those of the paper's table 2
    )
    worse = harmed(deployed, actual, mean_a=moment("unseen_mean_a"), mean_square_a2=moment("unseen_mean_square_a2"))
    return FleetScore(
        vehicles=len(truth.vehicles),
        left_out=len(truth.vehicles) - len(known),
        recovery_rate=share(within_10),
        recovery_rate_25=share(within_25),
        harmed_rate=share(worse),
        deployed_rate=share(np.asarray(applied.any(axis=1))),
        hardware_f2=f2_score(column("hardware_fault")[:, 0].astype(bool), actual.has_hardware_fault),
    )
