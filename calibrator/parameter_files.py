"""From what was found for one vehicle to its parameter file.

Parameters that leave a larger Kirchhoff sum than no correction at all are written down, but marked not to be applied,
and the verdict is 'cannot tell': whatever they are, they do not explain this vehicle's sensors.
"""

from collections.abc import Sequence

import numpy as np

from calibrator.drive import Array
from calibrator.identification.vehicle_model import VehicleModel, junction_rms_a
from calibrator.options import Method
from calibrator.published.recovery import Recovery
from ecu_node import __version__
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import (
    BranchParameters,
    FileReference,
    HardwareFault,
    JunctionResidual,
    Provenance,
    VehicleParameters,
    Verdict,
)

__all__ = ["parameters_of"]


def parameters_of(
    vehicle: VehicleModel,
    recovery: Recovery,
    position: int,
    *,
    branches: Sequence[str],
    database: VehicleDatabase,
    method: Method,
    fleet: str,
    fleet_size: int,
    created: str,
) -> VehicleParameters:
    """Write down what was found for one vehicle.

    Parameters
    ----------
    vehicle : VehicleModel
        The vehicle.
    recovery : Recovery
        What was found for the fleet.
    position : int
        Which row of it is this vehicle's.
    branches : sequence of str
        Names of the K branches.
    database : VehicleDatabase
        DBC and layout that the parameters belong to.
    method : Method
        How they were found.
    fleet, created : str
        Name of the fleet; time, ISO 8601.
    fleet_size : int
        Number of vehicles calibrated together.

    Returns
    -------
    VehicleParameters
        The content of the file.
    """
    faults = recovery.faults.take(position)
    sensor = bool(recovery.classification.sensor[position])
    zeros = np.zeros(len(branches))
    residual = JunctionResidual(
        measured_a=junction_rms_a(vehicle, drift=zeros, offset_a=zeros),
        corrected_a=junction_rms_a(vehicle, drift=faults.drift, offset_a=faults.offset_a),
    )
    helps = residual.corrected_a <= residual.measured_a
    verdict: Verdict = "no sensor fault" if not sensor else "corrected" if helps else "cannot tell"
    return VehicleParameters(
        vehicle=vehicle.vehicle,
        layout=FileReference(name=database.layout.name, sha256=database.layout.digest),
        dbc=FileReference(name=database.layout.dbc_path.name, sha256=database.digest),
        verdict=verdict,
        branches={
            name: BranchParameters(drift=float(faults.drift[k]), offset_a=float(faults.offset_a[k]), apply=helps)
            for k, name in enumerate(branches)
        },
        hardware_fault=HardwareFault(
            suspected=bool(recovery.classification.hardware[position]),
            drift=float(faults.hardware_drift),
            offset_a=_by_branch(branches, faults.hardware_offset_a),
        ),
        junction_residual=residual,
        provenance=Provenance(
            tool=f"calibrator {__version__}",
            method=method.value,
            created=created,
            fleet=fleet,
            fleet_size=fleet_size,
            drives=list(vehicle.drives),
            duration_s=round(vehicle.duration_s, 3),
        ),
    )


def _by_branch(branches: Sequence[str], values: Array) -> dict[str, float]:
    return dict(zip(branches, values.tolist(), strict=True))
