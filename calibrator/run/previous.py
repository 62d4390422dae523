"""An earlier result: whose parameters stay as they are, and which sensors have moved since."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibrator.errors import FleetError
from calibrator.evidence.readings import TRUSTED_DRIFT_SD, TRUSTED_OFFSET_SD
from calibrator.options import Method
from calibrator.posterior.estimate import FleetPosterior
from calibrator.results import PARTS, chunk_parameters, read_run
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters, decode_parameters, read_parameters

__all__ = ["PreviousResult", "moved_sensors", "require_previous"]

SURE = 4.0
"""Standard deviations from which on a sensor has moved. [1]"""


@dataclass(frozen=True, kw_only=True)
class PreviousResult:
    """A result of the same fleet, with the same layout.

    Attributes
    ----------
    folder : Path
        Where it is.
    """

    folder: Path

    def parameters(self, bucket: int, vehicles: Sequence[str]) -> dict[str, VehicleParameters]:
        """Parameters of those of some vehicles of one bucket that have any."""
        part = self.folder / PARTS / f"{bucket:05d}.parquet"
        if (self.folder / PARTS).is_dir():
            texts = dict(chunk_parameters(part.read_bytes())) if part.exists() else {}
            return {name: decode_parameters(texts[name], f"{part}: {name}") for name in vehicles if name in texts}
        paths = {name: self.folder / "params" / f"{name}.json" for name in vehicles}
        return {name: read_parameters(path) for name, path in paths.items() if path.exists()}


def require_previous(folder: Path, database: VehicleDatabase, branches: Sequence[str]) -> None:
    """Refuse an earlier result that a run cannot go on from.

    Parameters
    ----------
    folder : Path
        Where it is.
    database : VehicleDatabase
        Of the run that goes on from it.
    branches : sequence of str
        Of the fleet.

    Raises
    ------
    FleetError
        If it is none, or of another method, layout or other branches.
    """
    run = read_run(folder)
    if run.method != Method.POSTERIOR.value:
        raise FleetError(f"{folder}: a result of the method {run.method}; --since goes on from one of the posterior")
    if run.layout != database.layout.name or run.branches != list(branches):
        raise FleetError(
            f"{folder}: a result of layout {run.layout} with branches {', '.join(run.branches)}; this fleet is of "
            f"layout {database.layout.name} with {', '.join(branches)}: calibrate it without --since"
        )


def moved_sensors(
    before: VehicleParameters, now: FleetPosterior, j: int, branches: Sequence[str], *, full_scale_a: float
) -> dict[str, str]:
    """Sensors whose faults differ from earlier ones by more than both are unsure.

    Parameters
    ----------
    before : VehicleParameters
        Earlier parameters of a vehicle.
    now : FleetPosterior
        From drives that came since, and from these alone.
    j : int
        Position of the vehicle in it.
    branches : sequence of str
        Names of the K branches.
    full_scale_a : float
        Full scale of the junction. [A]

    Returns
    -------
    dict of str to str
        What has moved from where to where, by branch.
    """
    found: dict[str, str] = {}
    for k, name in enumerate(branches):
        old = before.branches[name]
        if not (old.identifiable and now.identifiable[j, k]) or old.drift_sd is None or old.offset_sd_a is None:
            continue
        drift, offset_a = float(now.faults.drift[j, k]), float(now.faults.offset_a[j, k])
        doubt = np.sqrt(old.drift_sd**2 + now.drift_sd[j, k] ** 2 + TRUSTED_DRIFT_SD**2)
        doubt_a = np.sqrt(old.offset_sd_a**2 + now.offset_sd_a[j, k] ** 2 + (TRUSTED_OFFSET_SD * full_scale_a) ** 2)
        texts = []
        if abs(drift - old.drift) > SURE * doubt:
            texts.append(f"drift {old.drift:+.2%} -> {drift:+.2%}")
        if abs(offset_a - old.offset_a) > SURE * doubt_a:
            texts.append(f"offset {old.offset_a:+.2f} A -> {offset_a:+.2f} A")
        if texts:
            found[name] = ", ".join(texts)
    return found
