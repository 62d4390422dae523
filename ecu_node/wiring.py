"""From layout, DBC and parameters to the node's core: everything is looked up once, at start."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from cantools.database.can import Message

from ecu_node.bits import BitPlace, bit_place
from ecu_node.branch import CurrentSensor, LiveBranch, PowerSensor, Republished, SensorFault, VoltageSensor
from ecu_node.codes import Codes, not_available_code, read_codes, writable_range
from ecu_node.correction import IntegerPlan, integer_plan
from ecu_node.corrector import Corrector, FrameKey, Source, StatusFields, Target
from ecu_node.database import AMPERE, VOLT, WATT, VehicleDatabase
from ecu_node.e2e import Receiver, Sender
from ecu_node.guard import PARAMETER_SETS, check_output, is_fd, key_of, received
from ecu_node.layout import Branch, SignalName, split_signal
from ecu_node.parameters import VehicleParameters
from ecu_node.status import Reason

__all__ = [
    "WHY_NOT_LINEAR",
    "WHY_NOT_PUBLISHED",
    "InForce",
    "branch_plan",
    "not_linear",
    "not_published",
    "sensor_fault",
    "wire",
]

WHY_NOT_PUBLISHED = "the parameters apply a fault to it, but the layout has no 'corrected' for it"

WHY_NOT_LINEAR = "its sensor model is not linear, and the node corrects linear sensors only"


@dataclass(frozen=True, kw_only=True)
class InForce:
    """Parameters in force, or the reason why there are none and measured values are passed through."""

    parameters: VehicleParameters | None
    reason: Reason = Reason.NONE


def sensor_fault(in_force: InForce, branch: str) -> SensorFault:
    """What is corrected on one branch: nothing without a linear fault that the parameters apply to it."""
    found = in_force.parameters.branches.get(branch) if in_force.parameters is not None else None
    if found is None or not found.apply or found.drift == found.offset_a == 0.0 or found.sensor_model is not None:
        return SensorFault()
    return SensorFault(drift=found.drift, offset_a=found.offset_a, applied=True)


def not_published(database: VehicleDatabase, in_force: InForce) -> list[str]:
    """Branches with a fault to correct, but no signal to publish the result in; it counts in the status' sum alone."""
    branches = database.layout.branch
    return [item.name for item in branches if item.corrected is None and sensor_fault(in_force, item.name).applied]


def not_linear(in_force: InForce) -> list[str]:
    """Branches that the parameters apply a sensor model to that is not linear; they are passed through."""
    branches = in_force.parameters.branches.items() if in_force.parameters is not None else ()
    return [name for name, found in branches if found.apply and found.sensor_model is not None]


def branch_plan(database: VehicleDatabase, branch: Branch, fault: SensorFault) -> IntegerPlan | None:
    """Integer plan of one branch.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    branch : Branch
        A branch of the layout.
    fault : SensorFault
        What is corrected on it.

    Returns
    -------
    IntegerPlan or None
        None for a branch that is not republished.

    Raises
    ------
    DatabaseError
        If the node cannot read or write one of the signals.
    """
    if branch.signal is None or branch.corrected is None:
        return None
    source = _codes(database, branch.signal, AMPERE, branch)
    target = _codes(database, branch.corrected, AMPERE, branch)
    return integer_plan(source, target, sign=branch.sign, drift=fault.drift, offset_a=fault.offset_a)


def wire(database: VehicleDatabase, in_force: InForce, start_s: float) -> Corrector:
    """Build the node's core.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    in_force : InForce
        Checked parameters, or why there are none.
    start_s : float
        Now; branches that the parameters name are waited for from here. [s]

    Returns
    -------
    Corrector
        Ready for frames.

    Raises
    ------
    LayoutError, DatabaseError
        If the node cannot do its work with this layout and DBC, see :func:`ecu_node.guard.check_output`.
    """
    check_output(database)
    layout = database.layout
    voltages = {
        branch.voltage: VoltageSensor(_codes(database, branch.voltage, VOLT, branch))
        for branch in layout.branch
        if branch.voltage is not None
    }
    branches = [_live(database, branch, in_force, voltages, start_s) for branch in layout.branch]
    return Corrector(
        sources=_sources(database, branches, voltages),
        branches=branches,
        status_fields=_status_fields(database),
        reason=in_force.reason,
        parameter_set=in_force.parameters.number % PARAMETER_SETS if in_force.parameters is not None else 0,
    )


def _codes(database: VehicleDatabase, name: SignalName, units: Mapping[str, float], branch: Branch) -> Codes:
    return read_codes(database.signal(name)[1], units, f"{database.layout.path}: branch {branch.name}")


def _live(
    database: VehicleDatabase,
    branch: Branch,
    in_force: InForce,
    voltages: Mapping[SignalName, VoltageSensor],
    start_s: float,
) -> LiveBranch:
    fault = sensor_fault(in_force, branch.name)
    expected = in_force.parameters is not None and branch.name in in_force.parameters.branches
    return LiveBranch(
        name=branch.name,
        sensor=_sensor(database, branch, voltages),
        fault=fault,
        timeout_s=branch.timeout_s,
        expected_since_s=start_s if expected else None,
        republished=_republished(database, branch, fault),
    )


def _sensor(
    database: VehicleDatabase, branch: Branch, voltages: Mapping[SignalName, VoltageSensor]
) -> CurrentSensor | PowerSensor:
    if branch.power is None or branch.voltage is None:
        return CurrentSensor(_codes(database, branch.source, AMPERE, branch), branch.sign)
    power = _codes(database, branch.power, WATT, branch)
    return PowerSensor(power, branch.sign, voltages[branch.voltage], branch.timeout_s)


def _republished(database: VehicleDatabase, branch: Branch, fault: SensorFault) -> Republished | None:
    plan = branch_plan(database, branch, fault)
    if plan is None or branch.corrected is None:
        return None
    target = _codes(database, branch.corrected, AMPERE, branch)
    return Republished(
        plan=plan,
        place=target.place,
        not_available=not_available_code(target, f"{database.layout.path}: branch {branch.name}"),
        quality=bit_place(database.signal(branch.quality)[1]) if branch.quality is not None else None,
    )


def _sources(
    database: VehicleDatabase, branches: Sequence[LiveBranch], voltages: Mapping[SignalName, VoltageSensor]
) -> dict[FrameKey, Source]:
    pairs = list(zip(database.layout.branch, branches, strict=True))
    targets = _targets(database, branches)
    sources = {}
    for key, message in received(database).items():
        inside = [(branch, live) for branch, live in pairs if split_signal(branch.source)[0] == message.name]
        answers = {split_signal(branch.corrected)[0]: None for branch, _ in inside if branch.corrected is not None}
        sources[key] = Source(
            receiver=Receiver(data_id) if (data_id := _data_id(database, message)) is not None else None,
            voltages=[sensor for name, sensor in voltages.items() if split_signal(name)[0] == message.name],
            branches=[live for _, live in inside],
            targets=[targets[name] for name in answers],
        )
    return sources


def _targets(database: VehicleDatabase, branches: Sequence[LiveBranch]) -> dict[str, Target]:
    inside: dict[str, list[LiveBranch]] = {}
    for branch, live in zip(database.layout.branch, branches, strict=True):
        if branch.corrected is not None:
            inside.setdefault(split_signal(branch.corrected)[0], []).append(live)
    messages = {name: database.message(name) for name in inside}
    return {
        name: Target(
            key=key_of(message),
            length=message.length,
            fd=is_fd(message),
            branches=inside[name],
            sender=_sender(database, message),
        )
        for name, message in messages.items()
    }


def _status_fields(database: VehicleDatabase) -> StatusFields | None:
    status = database.layout.status
    if status is None:
        return None
    message = database.message(status.message)
    where = f"{database.layout.path}: status"

    def place(name: str) -> BitPlace:
        return bit_place(database.signal(f"{message.name}.{name}")[1])

    def current(name: str | None) -> tuple[Codes, int] | None:
        if name is None:
            return None
        codes = read_codes(database.signal(f"{message.name}.{name}")[1], AMPERE, where)
        lowest, highest = writable_range(codes, where)
        return replace(codes, lowest=lowest, highest=highest), not_available_code(codes, where)

    return StatusFields(
        key=key_of(message),
        length=message.length,
        fd=is_fd(message),
        sender=_sender(database, message),
        state=place(status.state),
        reason=place(status.reason),
        parameter_set=place(status.parameter_set) if status.parameter_set is not None else None,
        sum_measured=current(status.sum_measured),
        sum_corrected=current(status.sum_corrected),
    )


def _data_id(database: VehicleDatabase, message: Message) -> int | None:
    """E2E data identifier of a message; None if the layout does not protect it."""
    e2e = database.layout.e2e
    if e2e is None or message.name not in e2e.messages:
        return None
    return e2e.data_id.get(message.name, message.frame_id & 0xFFFF)


def _sender(database: VehicleDatabase, message: Message) -> Sender | None:
    data_id = _data_id(database, message)
    return Sender(data_id) if data_id is not None else None
