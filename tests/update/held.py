"""States of vehicles that hold parameter sets, made without a repository."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

from msgspec.structs import replace

from ecu_node.parameters import VehicleParameters, encode_parameters
from ecu_node.update.state import ParameterSet, VehicleState, read_state, write_state

NOW = datetime(2026, 6, 1, 12, 0, tzinfo=UTC)


def held(parameters: VehicleParameters, *, days: int = 365) -> ParameterSet:
    """A set that expires some days after :data:`NOW`."""
    return ParameterSet(content=encode_parameters(parameters, "f").decode(), expires=NOW + timedelta(days=days))


def put_on_trial(vehicle: Path, parameters: VehicleParameters, *, days: int = 365) -> None:
    write_state(vehicle, replace(read_state(vehicle), on_trial=held(parameters, days=days)))


def new_vehicle(folder: Path, in_force: ParameterSet | None = None) -> Path:
    folder.mkdir()
    write_state(folder, VehicleState(vehicle="v1", latest=NOW, root="{}", in_force=in_force))
    return folder
