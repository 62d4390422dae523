"""Compare a result with the truth of its artificial fleet, for ``calibrator score``."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from calibrator.drive import Array
from calibrator.errors import FleetError
from calibrator.estimator.results import read_results, read_run
from calibrator.faults import Faults
from calibrator.fleet_truth import read_truth
from calibrator.score import f2_score, harmed, recovered

__all__ = ["WORDS", "score_result"]

WORDS = {
    "vehicles": "vehicles",
    "left_out": "left out",
    "recovery_rate": "recovered within 10 %",
    "recovery_rate_25": "recovered within 25 %",
    "harmed_rate": "harmed, of all vehicles",
    "deployed_rate": "with parameters to apply",
    "hardware_f2": "f2 of the hardware suspicion",
}
"""Names of the figures of a score, and how people read them."""


def score_result(result: Path, truth_file: Path) -> dict[str, float]:
    """Compare ``RESULT/results.parquet`` with ``truth.json``.

    Parameters
    ----------
    result : Path
        Folder that ``calibrator calibrate`` wrote.
    truth_file : Path
        File that ``calibrator simulate`` wrote.

    Returns
    -------
    dict of str to float
        By the names of :data:`WORDS`: numbers of vehicles in the truth, and of those without parameters; shares of all
        vehicles that are recovered within 10 % and 25 % (without parameters they are not), that are harmed, and to
        which the node applies parameters; f2 score of the hardware suspicion, over vehicles with parameters.

    Raises
    ------
    FleetError
        If one of them cannot be read, or they are of different fleets or branches.
    """
    truth, run = read_truth(truth_file), read_run(result)
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

    def found(name: str) -> Array:
        """One column of the result, shape (N, K)."""
        return np.asarray(rows[name].unstack("branch").loc[known, truth.branches].to_numpy(dtype=float))

    def true(name: str) -> Array:
        """One field of the truth about the vehicles, shape (N, K)."""
        return np.array([[getattr(truth.vehicles[v], name)[branch] for branch in truth.branches] for v in known])

    by_branch, applied = ("hardware_offset_a", "drift", "offset_a"), found("applied")
    drift_h = found("hardware_drift")[:, 0], np.array([truth.vehicles[v].hardware_drift for v in known])
    estimate = Faults(hardware_drift=drift_h[0], **{name: found(name) for name in by_branch})
    actual = Faults(hardware_drift=drift_h[1], **{name: true(name) for name in by_branch})
    deployed = replace(
        estimate,
        drift=np.where(applied, estimate.drift, 0.0),
        offset_a=np.where(applied, estimate.offset_a, 0.0),
    )
    within_10, within_25 = (  # those of the paper's table 2
        recovered(estimate, actual, full_scale_a=truth.full_scale_a, smallest_fault=truth.magnitude[0], tolerance=t)
        for t in (0.10, 0.25)
    )
    worse = harmed(deployed, actual, mean_a=true("unseen_mean_a"), mean_square_a2=true("unseen_mean_square_a2"))
    counted = (within_10, within_25, worse, applied.any(axis=1))
    N = len(truth.vehicles)
    f2 = f2_score(found("hardware_fault")[:, 0].astype(bool), actual.has_hardware_fault)
    figures = (N, N - len(known), *(float(mask.sum()) / N for mask in counted), f2)
    return dict(zip(WORDS, figures, strict=True))
