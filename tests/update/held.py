"""Parameter sets that a vehicle holds, put there without a repository."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

from msgspec.structs import replace

from ecu_node.parameters import VehicleParameters, encode_parameters
from ecu_node.update.state import ParameterSet, read_state, write_state

NOW = datetime.now(UTC)


def held(parameters: VehicleParameters, *, days: int = 365) -> ParameterSet:
    """A set that expires some days after :data:`NOW`."""
    return ParameterSet(content=encode_parameters(parameters, "f").decode(), expires=NOW + timedelta(days=days))


def put_on_trial(vehicle: Path, parameters: VehicleParameters, *, days: int = 365) -> None:
    write_state(vehicle, replace(read_state(vehicle), on_trial=held(parameters, days=days)))
