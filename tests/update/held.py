"""Parameter sets put into the state of a vehicle without a repository, and the node that uses them."""

from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from ecu_node.bus.wiring import Mode, wire
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters, encode_parameters
from ecu_node.update.state import ParameterSet, read_state, write_state
from ecu_node.update.store import ParameterStore
from tests.ecu_node.vehicles import AtOnce

NOW = datetime.now(UTC)


def held(parameters: VehicleParameters, *, days: int = 365) -> ParameterSet:
    """A set that expires some days after :data:`NOW`."""
    return ParameterSet(content=encode_parameters(parameters, "f").decode(), expires=NOW + timedelta(days=days))


def put_on_trial(vehicle: Path, parameters: VehicleParameters, *, days: int = 365) -> None:
    write_state(vehicle, replace(read_state(vehicle), on_trial=held(parameters, days=days)))


class Running:
    """The core of a node with the store of its parameters, in simulated time."""

    def __init__(self, state: Path, database: VehicleDatabase, **options: Any) -> None:
        self.database, self.now, self.said = database, NOW, list[str]()
        options.setdefault("background", AtOnce())
        make = partial(ParameterStore, mode=Mode.OVERLAY, say=self.said.append, now=lambda: self.now)
        self.store = make(state, database, **options)
        self.corrector = wire(database, self.store.in_force, 0.0)

    def look(self, *times_s: float) -> list[bool]:
        return [self.store.look(self.corrector, now_s) for now_s in times_s]

    @property
    def drift(self) -> float:
        return self.corrector.branches[0].fault.drift
