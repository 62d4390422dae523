"""Parameters that are known, for vehicles of the benchmarks that were made up."""

from collections.abc import Mapping

from ecu_node.database import VehicleDatabase
from ecu_node.parameters import (
    BranchParameters,
    FileReference,
    HardwareFault,
    JunctionResidual,
    Provenance,
    VehicleParameters,
)

__all__ = ["true_parameters"]


def true_parameters(database: VehicleDatabase, branches: Mapping[str, BranchParameters]) -> VehicleParameters:
    """Parameters that fit a layout and its DBC.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    branches : mapping of str to BranchParameters
        What is wrong with each sensor.

    Returns
    -------
    VehicleParameters
        As the calibrator writes them; it expects the corrected sum to be no worse than the measured one.
    """
    layout = database.layout
    return VehicleParameters(
        vehicle="bench",
        layout=FileReference(name=layout.path.name, sha256=layout.digest),
        dbc=FileReference(name=layout.dbc_path.name, sha256=database.digest),
        verdict="corrected",
        branches=dict(branches),
        hardware_fault=HardwareFault(suspected=False),
        junction_residual=JunctionResidual(measured_a=1.0, corrected_a=1.0),
        provenance=Provenance(
            tool="bench", method="truth", created="2026-01-01", fleet="b", fleet_size=1, drives=[], duration_s=1.0
        ),
    )
