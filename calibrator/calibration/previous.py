"""An earlier result: whose parameters stay as they are, and which sensors have moved since."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibrator.errors import FleetError
from calibrator.evidence.readings import TRUSTED_DRIFT_SD, TRUSTED_OFFSET_SD
from calibrator.options import Method
from calibrator.posterior.estimate import FleetPosterior
from calibrator.results.parameter_parts import PARTS, Written, read_part
from calibrator.results.run_record import read_run
from calibrator.summaries.identity import StoreIdentity
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import BranchParameters, VehicleParameters

__all__ = ["PreviousResult", "moved_sensors", "require_previous"]

SURE = 4.0
"""Standard deviations within which two values are one. [1]"""
LEAST_PROBABILITY = 1e-3
"""Of the explanations near the earlier faults: below, a sensor has moved. [1]"""


@dataclass(frozen=True, kw_only=True)
class PreviousResult:
    """A result of the same fleet, with the same layout.

    Attributes
    ----------
    folder : Path
        Where it is.
    """

    folder: Path

    def written(self, bucket: int) -> dict[str, Written]:
        """Parameters of the vehicles of a bucket, by name; raises FleetError if they cannot be read."""
        if not (self.folder / PARTS).is_dir():
            raise FleetError(
                f"{self.folder / PARTS}: the earlier result cannot be reached from here; put it where every worker "
                f"reaches it by this path"
            )
        return read_part(self.folder / PARTS / f"{bucket:05d}.parquet")


def require_previous(folder: Path, database: VehicleDatabase, store: StoreIdentity) -> None:
    """Refuse an earlier result that a run cannot go on from.

    Parameters
    ----------
    folder : Path
        Where it is.
    database : VehicleDatabase
        Of the run that goes on from it.
    store : StoreIdentity
        Of the store of summaries.

    Raises
    ------
    FleetError
        If it is none, or of another method, layout or other branches.
    """
    run = read_run(folder)
    if run.method != Method.POSTERIOR.value:
        raise FleetError(f"{folder}: a result of the method {run.method}; --since goes on from one of the posterior")
    if run.branches != list(store.branches):
        raise FleetError(
            f"{folder}: a result with branches {', '.join(run.branches)}; this fleet has {', '.join(store.branches)}: "
            f"calibrate it without --since"
        )
    if not (folder / PARTS).is_dir():
        raise FleetError(
            f"{folder / PARTS}: no such folder; expected the parameters of the earlier result: give the whole folder "
            f"that 'calibrator calibrate' wrote, or calibrate without --since"
        )
    if (run.layout_sha256, run.dbc_sha256) != (database.layout.digest, database.digest):
        raise FleetError(
            f"{folder}: made with another version of layout or DBC than {database.layout.path}; the node would not "
            f"accept its parameters: calibrate without --since"
        )
    if run.buckets != store.buckets:
        raise FleetError(
            f"{folder}: made from a store of {run.buckets} buckets, and this one has {store.buckets}; give the same "
            f"store, with the new drives added, or calibrate without --since"
        )


def moved_sensors(
    before: VehicleParameters, now: FleetPosterior, branches: Sequence[str], *, full_scale_a: float
) -> dict[str, str]:
    """Sensors that have moved: the earlier faults of a vehicle are none of the explanations of its new drives.

    Parameters
    ----------
    before : VehicleParameters
        Earlier parameters of the vehicle.
    now : FleetPosterior
        Of the vehicle, from drives that came since and from these alone.
    branches : sequence of str
        Names of the K branches.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    dict of str to str
        What has moved from where to where, by branch; nothing if the earlier faults still explain the vehicle.
    """
    old = [before.branches[branches[k]] for k in now.order]
    scale = np.repeat([1.0, full_scale_a], len(old))
    value = np.array([*(item.drift for item in old), *(item.offset_a for item in old)]) / scale
    sd = np.array([*(item.drift_sd or 0.0 for item in old), *(item.offset_sd_a or 0.0 for item in old)]) / scale
    accuracy = np.repeat([TRUSTED_DRIFT_SD, TRUSTED_OFFSET_SD], len(old))
    states, K = now.states, len(old)
    found = np.concatenate([states.drift[0], states.offset[0]], axis=1)
    found_sd = np.concatenate([states.relative_sd[0][:, 1:], states.constant_sd[0][:, K - 1 :]], axis=1)
    apart = np.abs(found - value) / np.sqrt(found_sd**2 + sd**2 + accuracy**2)
    if states.weight[0] @ (apart <= SURE).all(axis=1) >= LEAST_PROBABILITY:
        return {}
    best = apart[int(np.argmax(states.weight[0]))]
    moved = [branches[now.order[int(place) % K]] for place in np.flatnonzero(best > SURE)]
    return {name: _change(before.branches[name], now, branches.index(name)) for name in dict.fromkeys(moved)}


def _change(old: BranchParameters, now: FleetPosterior, k: int) -> str:
    drift, offset_a = now.faults.drift[0, k], now.faults.offset_a[0, k]
    return f"drift {old.drift:+.2%} -> {drift:+.2%}, offset {old.offset_a:+.2f} A -> {offset_a:+.2f} A"
