"""What a result says of its run: which fleet, when, how."""

from collections.abc import Mapping
from dataclasses import dataclass

from calibrator.calibration_settings import CalibrationSettings
from calibrator.files.parameter_files import RunIdentity
from calibrator.sources.fleet_source import Equipment, FleetSource
from calibrator.summaries.store import SummaryStore
from ecu_node.database import VehicleDatabase

__all__ = ["FleetFacts", "run_identity"]


@dataclass(frozen=True, kw_only=True)
class FleetFacts:
    """What a result says of its fleet."""

    name: str
    fleet_ids: tuple[str, ...]
    equipment: Equipment
    left_out: Mapping[str, str]
    notices: tuple[str, ...]

    @classmethod
    def of_drives(cls, fleet: FleetSource, equipment: Equipment) -> "FleetFacts":
        """Of a fleet whose drives are read."""
        return cls(
            name=fleet.path.resolve().name,
            fleet_ids=tuple(sorted(fleet.fleet_ids)),
            equipment=equipment,
            left_out=fleet.left_out,
            notices=(*fleet.notices, *equipment.notices),
        )

    @classmethod
    def of_store(cls, store: SummaryStore) -> "FleetFacts":
        """Of a fleet whose summaries are in a store."""
        identity = store.identity
        return cls(
            name=identity.fleet,
            fleet_ids=identity.fleet_ids,
            equipment=identity.equipment,
            left_out={},
            notices=identity.notices,
        )


def run_identity(
    fleet: FleetFacts, database: VehicleDatabase, settings: CalibrationSettings, *, created: str
) -> RunIdentity:
    """What all parameter files of a run have in common."""
    return RunIdentity(database=database, method=settings.method, fleet=fleet.name, created=created)
