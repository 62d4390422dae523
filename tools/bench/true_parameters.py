"""Makes the true parameters of the made-up vehicles of the benchmarks."""

from collections.abc import Mapping
from datetime import UTC, datetime

import msgspec

from ecu_node.cli import template_text
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import BranchParameters, JunctionResidual, VehicleParameters

__all__ = ["true_parameters"]


def true_parameters(database: VehicleDatabase, branches: Mapping[str, BranchParameters]) -> VehicleParameters:
    """Make parameters that fit a layout and its DBC, with the given fault of each sensor.

    The corrected sum is expected to be no worse than the measured one.
    """
    template = template_text(database, "bench", datetime(2026, 1, 1, tzinfo=UTC))
    return msgspec.structs.replace(
        msgspec.json.decode(template, type=VehicleParameters),
        branches=dict(branches),
        junction_residual=JunctionResidual(measured_a=1.0, corrected_a=1.0),
    )
