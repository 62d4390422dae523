"""What becomes of one vehicle of the chain: it updates, and its set is tried on the road, and judged on the rest."""

from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import replace as replace_trace
from datetime import UTC, datetime
from pathlib import Path

from msgspec.structs import replace

from chain.fleet import ChainFleet
from chain.node_drive import BranchTrace, NodeDrive, drive_through
from ecu_node.bus.wiring import InForce, Mode, sensor_fault, wire
from ecu_node.core.status import State
from ecu_node.errors import UserError
from ecu_node.parameters import BranchParameters, VehicleParameters
from ecu_node.update.client import provision, update
from ecu_node.update.store import ParameterStore
from ecu_node.update.trial import ParameterTrial, TrialResult

__all__ = ["VehicleOutcome", "WrongSet", "drive_vehicle"]

UNSEEN_STREAM = 1
"""Second part of the seed of the frames of an unseen drive; those of the drive to learn from have none."""


@dataclass(frozen=True, kw_only=True)
class WrongSet:
    """How a set that is wrong for this vehicle did on its trial.

    Attributes
    ----------
    passed : bool
        Whether it passed.
    worse : bool
        Whether it makes a branch worse.
    """

    passed: bool
    worse: bool


@dataclass(frozen=True, kw_only=True)
class VehicleOutcome:
    """What became of one vehicle.

    Attributes
    ----------
    vehicle : str
        Its name.
    corrected : tuple of str
        Branches that its parameters correct; none: it took no update.
    refused : str
        Why its update was refused; empty if it was not.
    passed : bool
        Whether it passed its trial.
    text : str
        How the trial ended.
    fell_back : bool
        Whether the node passed measured values through at the end all the same.
    worse : tuple of str
        Branches that were worse as published than as measured, on the drive after the trial.
    measured_a, published_a : float
        Largest root mean square error of its corrected branches on that drive; 0 without any. [A]
    wrong : mapping of str to WrongSet
        Wrong sets on trial beside the right one.
    """

    vehicle: str
    corrected: tuple[str, ...]
    refused: str = ""
    passed: bool = False
    text: str = ""
    fell_back: bool = False
    worse: tuple[str, ...] = ()
    measured_a: float = 0.0
    published_a: float = 0.0
    wrong: Mapping[str, WrongSet]


def drive_vehicle(
    fleet: ChainFleet,
    number: int,
    parameters: VehicleParameters,
    others: VehicleParameters,
    *,
    repository: Path,
    state: Path,
) -> VehicleOutcome:
    """Update a vehicle, and drive.

    Parameters
    ----------
    fleet : ChainFleet
        The fleet.
    number : int
        Of the vehicle.
    parameters : VehicleParameters
        Its own, as they are published.
    others : VehicleParameters
        Of another vehicle.
    repository : Path
        What it trusts.
    state : Path
        Folder for the state of the vehicle.

    Returns
    -------
    VehicleOutcome
        What became of it.
    """
    name, database = fleet.vehicles[number].name, fleet.database
    corrected = tuple(branch for branch, found in parameters.branches.items() if found.apply)
    if not corrected:
        return VehicleOutcome(vehicle=name, corrected=(), wrong={})
    provision(state, name, repository / "metadata" / "1.root.json", datetime.now(UTC))
    try:
        update(state, str(repository), database, datetime.now(UTC))
    except UserError as error:
        return VehicleOutcome(vehicle=name, corrected=corrected, refused=str(error), wrong={})
    said: list[str] = []
    store = ParameterStore(state, database, mode=Mode.OVERLAY, say=said.append, now=lambda: datetime.now(UTC))
    corrector = wire(database, store.in_force, 0.0)
    sets = {"signs turned": _turned(parameters), "of another vehicle": replace(others, vehicle=name)}
    trials = {kind: _WrongTrial(ParameterTrial(found, database, corrector.branches)) for kind, found in sets.items()}
    in_force_s = float("inf")

    def look(time_s: float) -> None:
        nonlocal in_force_s
        if store.look(corrector, time_s):
            in_force_s = min(in_force_s, time_s)
        for trial in trials.values():
            trial.look(time_s)

    drive = NodeDrive(
        database=database,
        vehicle=fleet.vehicles[number],
        trip=fleet.trip(number, "unseen"),
        seed=(fleet.seed, number, UNSEEN_STREAM),
    )
    traces = drive_through(drive, corrector, look)
    passed = in_force_s < float("inf")
    after = {branch: trace.errors(in_force_s) for branch, trace in traces.items()} if passed else {}
    return VehicleOutcome(
        vehicle=name,
        corrected=corrected,
        passed=passed,
        text=next((line for line in said if "its trial" in line), "the trial did not end"),
        fell_back=corrector.state()[0] is not State.CORRECTING,
        worse=tuple(branch for branch, errors in after.items() if errors.is_worse),
        measured_a=max((after[branch].measured_a for branch in corrected if passed), default=0.0),
        published_a=max((after[branch].published_a for branch in corrected if passed), default=0.0),
        wrong={
            kind: WrongSet(passed=trial.passed, worse=_is_worse(sets[kind], traces)) for kind, trial in trials.items()
        },
    )


class _WrongTrial:
    """Trial of a set that is not in the vehicle's state."""

    def __init__(self, trial: ParameterTrial) -> None:
        self._trial = trial
        self._result: TrialResult | None = None

    @property
    def passed(self) -> bool:
        return self._result is not None and self._result.passed

    def look(self, time_s: float) -> None:
        if self._result is None:
            self._result = self._trial.look(time_s)


def _turned(parameters: VehicleParameters) -> VehicleParameters:
    """The same corrections with the other sign."""

    def turned(branch: BranchParameters) -> BranchParameters:
        return replace(branch, drift=-branch.drift, offset_a=-branch.offset_a)

    return replace(parameters, branches={name: turned(branch) for name, branch in parameters.branches.items()})


def _is_worse(parameters: VehicleParameters, traces: Mapping[str, BranchTrace]) -> bool:
    """Whether a set would make a branch worse."""
    for name, trace in traces.items():
        fault = sensor_fault(InForce(parameters=parameters), name)
        if not fault.applied:
            continue
        published_a = (trace.measured_a - fault.offset_a) / (1.0 + fault.drift)
        if replace_trace(trace, published_a=published_a).errors().is_worse:
            return True
    return False
