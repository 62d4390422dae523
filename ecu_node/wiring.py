"""From layout, DBC and parameters to the node's core: everything is looked up once, at start.

The structure (:func:`wire`) depends on layout and DBC alone; parameters are put in force in it, so that they can be
replaced while the node runs (:func:`put_in_force`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from cantools.database.can import Message, Signal

from ecu_node.auxiliary import Auxiliary
from ecu_node.bits import BitPlace, PlacedSignal, bit_place, multiplexers
from ecu_node.branch import LiveBranch
from ecu_node.codes import Codes, as_written, not_available_code, read_codes, require_reach, writable_range
from ecu_node.correction import AS_IT_IS, CorrectionPlan, IntegerPlan, Signals, TemperaturePlans, correction_plan
from ecu_node.corrector import Corrector, StatusFields
from ecu_node.counters import Counters
from ecu_node.database import AMPERE, CELSIUS, VOLT, WATT, VehicleDatabase
from ecu_node.e2e_profiles import protection_of
from ecu_node.errors import LayoutError
from ecu_node.frames import FrameKey, Reader, Source, Target, TargetField
from ecu_node.guard import PARAMETER_SETS, Mode, check_output, is_fd, key_of, received
from ecu_node.junction_watch import JunctionWatch
from ecu_node.layout import Branch, SignalName, split_signal
from ecu_node.parameters import VehicleParameters
from ecu_node.sensor_fault import NO_FAULT, SensorFault
from ecu_node.sensor_models import TemperatureDrift
from ecu_node.status import Reason

__all__ = [
    "InForce",
    "branch_plan",
    "branch_signals",
    "no_temperature",
    "not_published",
    "put_in_force",
    "sensor_fault",
    "wire",
]


@dataclass(frozen=True, kw_only=True)
class InForce:
    """Parameters in force, or the reason why there are none and measured values are passed through."""

    parameters: VehicleParameters | None
    reason: Reason = Reason.NONE


def sensor_fault(database: VehicleDatabase, in_force: InForce, branch: str) -> SensorFault:
    """What is corrected on one branch; :data:`NO_FAULT` where the parameters apply none, or it cannot be applied."""
    found = in_force.parameters.branches.get(branch) if in_force.parameters is not None else None
    if found is None or not found.apply:
        return NO_FAULT
    if isinstance(found.sensor_model, TemperatureDrift) and database.layout.temperature is None:
        return NO_FAULT
    return SensorFault(
        drift=found.drift,
        offset_a=found.offset_a,
        model=found.sensor_model,
        largest_drift=database.layout.limits.drift,
    )


def not_published(database: VehicleDatabase, in_force: InForce) -> list[str]:
    """Branches with a fault to correct, but no signal to publish the result in; it counts in the status' sum alone."""
    names = [branch.name for branch in database.layout.branch if branch.corrected is None]
    return [name for name in names if sensor_fault(database, in_force, name).applied]


def no_temperature(database: VehicleDatabase, in_force: InForce) -> list[str]:
    """Branches whose fault depends on a temperature that the layout does not name; they are passed through."""
    found = in_force.parameters.branches if in_force.parameters is not None else {}
    names = [name for name, item in found.items() if item.apply and isinstance(item.sensor_model, TemperatureDrift)]
    return names if database.layout.temperature is None else []


def branch_signals(database: VehicleDatabase, branch: Branch, mode: Mode) -> Signals:
    """What a branch is read from and written to.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    branch : Branch
        A branch of the layout.
    mode : Mode
        In a gateway every branch is written back where it was read; else where the layout says, if it does.

    Returns
    -------
    Signals
        The source itself as target where nothing is published.

    Raises
    ------
    DatabaseError
        If the node cannot read or write one of the signals.
    """
    units = AMPERE if branch.signal is not None else WATT
    source = _codes(database, branch.source, units, f"branch {branch.name}", branch.no_value)
    target = source
    if mode is Mode.OVERLAY and branch.corrected is not None:
        target = _codes(database, branch.corrected, units, f"branch {branch.name}")
    voltage = _codes(database, branch.voltage, VOLT, f"branch {branch.name}") if branch.voltage is not None else None
    return Signals(source=source, target=target, sign=branch.sign, voltage=voltage)


def branch_plan(database: VehicleDatabase, branch: Branch, fault: SensorFault, mode: Mode) -> CorrectionPlan:
    """Integer plan of one branch.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    branch : Branch
        A branch of the layout.
    fault : SensorFault
        What is corrected on it.
    mode : Mode
        Where it is written.

    Returns
    -------
    CorrectionPlan
        The plan.

    Raises
    ------
    DatabaseError
        If the node cannot read or write one of the signals.
    """
    return correction_plan(
        branch_signals(database, branch, mode),
        fault,
        temperature=_temperature_codes(database),
    )


def wire(
    database: VehicleDatabase,
    in_force: InForce,
    start_s: float,
    *,
    mode: Mode = Mode.OVERLAY,
    shadow: bool = False,
) -> Corrector:
    """Build the node's core.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    in_force : InForce
        Checked parameters, or why there are none.
    start_s : float
        Now; branches that the parameters name are waited for from here. [s]
    mode : Mode
        Where corrected values go.
    shadow : bool
        Compute and report, change nothing.

    Returns
    -------
    Corrector
        Ready for frames.

    Raises
    ------
    LayoutError, DatabaseError
        If the node cannot do its work with this layout and DBC, see :func:`ecu_node.guard.check_output`.
    """
    check_output(database, mode)
    _require_reach(database, mode)
    layout = database.layout
    parts = _parts(database)
    targets = _targets(database, parts) if mode is Mode.OVERLAY else {}
    counters = Counters()
    corrector = Corrector(
        sources=_sources(database, parts, targets, counters),
        branches=list(parts.branches.values()),
        auxiliaries=parts.auxiliaries,
        status_fields=_status_fields(database),
        watch=JunctionWatch(
            list(parts.branches.values()),
            window_s=layout.watch.window_s,
            margin_a=layout.watch_margin_a,
            full_scale_a=layout.full_scale_a,
            is_whole=parts.is_whole,
        ),
        counters=counters,
        shadow=shadow,
    )
    put_in_force(corrector, database, in_force, start_s, mode=mode)
    return corrector


def put_in_force(
    corrector: Corrector, database: VehicleDatabase, in_force: InForce, now_s: float, *, mode: Mode
) -> None:
    """Let a corrector work with these parameters from now on.

    Parameters
    ----------
    corrector : Corrector
        Built from the same layout and DBC.
    database : VehicleDatabase
        Layout and DBC.
    in_force : InForce
        Checked parameters, or why there are none.
    now_s : float
        Now; branches that the parameters name are waited for from here. [s]
    mode : Mode
        Where corrected values go.
    """
    parameters = in_force.parameters
    found = parameters.branches if parameters is not None else {}
    plans = []  # all of them before the first is put in force: either all or none
    for branch in database.layout.branch:
        fault = sensor_fault(database, in_force, branch.name)
        plans.append((branch, fault, branch_plan(database, branch, fault, mode)))
    hot = any(isinstance(plan, TemperaturePlans) for _, _, plan in plans)
    for live in corrector.branches:
        if live.temperature is not None:
            live.temperature.is_needed = hot
    for (branch, fault, plan), live in zip(plans, corrector.branches, strict=True):
        delay_s = found[branch.name].delay_s if branch.name in found else None
        live.put_in_force(
            fault=fault,
            plan=plan,
            passing=_passing(database, branch, mode),
            delay_s=delay_s or 0.0,
            expected_since_s=now_s if branch.name in found else None,
            counters=corrector.counters,
        )
    if parameters is None:
        corrector.put_in_force(reason=in_force.reason, parameter_set=0)
        return
    measured_a, corrected_a = parameters.junction_residual.about_expected()
    corrector.put_in_force(
        reason=in_force.reason,
        parameter_set=parameters.number % PARAMETER_SETS,
        expected_a=parameters.junction_residual.expected_a,
        predicted_worse_a=corrected_a - measured_a,
    )


def _require_reach(database: VehicleDatabase, mode: Mode) -> None:
    """Refuse to write signals in which full scale cannot be written for a name amid their values."""
    layout = database.layout
    for branch in layout.branch:
        if mode is Mode.OVERLAY and branch.corrected is None:
            continue
        signals = branch_signals(database, branch, mode)
        largest = as_written(layout.full_scale_a)
        if signals.voltage is not None:
            largest *= max(
                abs(signals.voltage.worth(code)) for code in (signals.voltage.lowest, signals.voltage.highest)
            )
        require_reach(signals.target, largest, f"{layout.path}: branch {branch.name}")


@dataclass(kw_only=True)
class _Parts:
    """Branches and auxiliary signals, and by which signal each is read."""

    branches: dict[str, LiveBranch]
    signals: list[tuple[SignalName, Auxiliary | LiveBranch]]
    auxiliaries: list[Auxiliary] = field(default_factory=list)
    whole: tuple[Auxiliary, frozenset[int]] | None = None
    """The input that tells whether all currents are measured, and its codes with which they are."""

    def is_whole(self) -> bool:
        """Whether all currents of the junction are measured now."""
        return self.whole is None or self.whole[0].code in self.whole[1]


def _parts(database: VehicleDatabase) -> _Parts:
    layout = database.layout
    parts = _Parts(branches={}, signals=[])

    def auxiliary(name: SignalName, codes: Codes, timeout_s: float) -> Auxiliary:
        item = Auxiliary(codes, timeout_s)
        parts.auxiliaries.append(item)
        parts.signals.append((name, item))
        return item

    whole_name = _input_signal(database, layout.watch.input)
    if whole_name is not None:
        unit = database.signal(whole_name)[1].unit or ""
        codes = _codes(database, whole_name, {unit: 1.0}, "[watch] input")
        every_code = replace(codes, named={})  # states have names, which are no lack of a value here
        valid = [(as_written(float(value)) - codes.offset) / codes.scale for value in layout.watch.valid]
        parts.whole = auxiliary(whole_name, every_code, layout.max_age_s), frozenset(map(int, valid))
    voltages: dict[SignalName, Auxiliary] = {}
    for branch in layout.branch:
        if branch.voltage is not None and branch.voltage not in voltages:
            codes = _codes(database, branch.voltage, VOLT, f"branch {branch.name}")
            timeout_s = max(item.timeout_s for item in layout.branch if item.voltage == branch.voltage)
            voltages[branch.voltage] = auxiliary(branch.voltage, codes, timeout_s)
    temperature_name, temperature_codes = _input_signal(database, layout.temperature), _temperature_codes(database)
    temperature = None  # after the voltages, as a new temperature makes values anew, with the voltage of its frame
    if temperature_name is not None and temperature_codes is not None:
        temperature = auxiliary(temperature_name, temperature_codes, layout.max_age_s)
    for branch in layout.branch:
        signals = branch_signals(database, branch, Mode.GATEWAY)
        live = LiveBranch(
            name=branch.name,
            codes=signals.source,
            sign=branch.sign,
            timeout_s=branch.timeout_s,
            start_s=layout.watch.start_s,
            voltage=voltages[branch.voltage] if branch.voltage is not None else None,
            temperature=temperature,
        )
        parts.branches[branch.name] = live
        parts.signals.append((branch.source, live))
    return parts


def _passing(database: VehicleDatabase, branch: Branch, mode: Mode) -> IntegerPlan:
    """What is written of a branch where nothing is corrected: its code, or the same current in the target's codes."""
    if mode is Mode.GATEWAY or branch.corrected is None:
        return AS_IT_IS
    plan = branch_plan(database, branch, NO_FAULT, mode)
    assert isinstance(plan, IntegerPlan)
    return plan


def _sources(
    database: VehicleDatabase, parts: _Parts, targets: Mapping[str, Target], counters: Counters
) -> dict[FrameKey, Source]:
    sources = {}
    for key, message in received(database).items():
        inside = [(name, part) for name, part in parts.signals if split_signal(name)[0] == message.name]
        readers = [Reader(part, _placed(message, database.signal(name)[1])) for name, part in inside]
        branches = [branch for branch in database.layout.branch if split_signal(branch.source)[0] == message.name]
        answers = dict.fromkeys(
            split_signal(branch.corrected)[0] for branch in branches if branch.corrected is not None
        )
        sources[key] = Source(
            length=message.length,
            protection=protection_of(database, message),
            readers=readers,
            targets=[targets[name] for name in answers if name in targets],
            counters=counters,
            pass_on_invalid=database.layout.on_bad_frame == "invalid",
        )
    return sources


def _placed(message: Message, signal: Signal) -> PlacedSignal:
    return PlacedSignal(place=bit_place(signal), above=multiplexers(message, signal))


def _targets(database: VehicleDatabase, parts: _Parts) -> dict[str, Target]:
    fields: dict[str, list[TargetField]] = {}
    for branch in database.layout.branch:
        if branch.corrected is None:
            continue
        codes = branch_signals(database, branch, Mode.OVERLAY).target
        fields.setdefault(split_signal(branch.corrected)[0], []).append(
            TargetField(
                branch=parts.branches[branch.name],
                place=codes.place,
                not_available=not_available_code(codes, f"{database.layout.path}: branch {branch.name}"),
                quality=bit_place(database.signal(branch.quality)[1]) if branch.quality is not None else None,
            )
        )
    messages = {name: database.message(name) for name in fields}
    return {
        name: Target(
            key=key_of(message),
            length=message.length,
            fd=is_fd(message),
            fields=fields[name],
            protection=protection_of(database, message),
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

    def place_or_none(name: str | None) -> BitPlace | None:
        return place(name) if name is not None else None

    def current(name: str | None) -> tuple[Codes, int] | None:
        if name is None:
            return None
        codes = read_codes(database.signal(f"{message.name}.{name}")[1], AMPERE, where)
        require_reach(codes, as_written(database.layout.full_scale_a), where)
        lowest, highest = writable_range(codes, where)
        return replace(codes, lowest=lowest, highest=highest), not_available_code(codes, where)

    return StatusFields(
        key=key_of(message),
        length=message.length,
        fd=is_fd(message),
        protection=protection_of(database, message),
        state=place(status.state),
        reason=place(status.reason),
        parameter_set=place_or_none(status.parameter_set),
        alive_counter=place_or_none(status.alive_counter),
        sum_measured=current(status.sum_measured),
        sum_corrected=current(status.sum_corrected),
    )


def _codes(
    database: VehicleDatabase,
    name: SignalName,
    units: Mapping[str, float],
    what: str,
    no_value: list[int] | None = None,
) -> Codes:
    codes = read_codes(database.signal(name)[1], units, f"{database.layout.path}: {what}")
    place = codes.place
    if impossible := [code for code in no_value or [] if not place.lowest <= code <= place.highest]:
        raise LayoutError(
            f"{database.layout.path}: {what}: no_value: {name} has no code {', '.join(map(str, impossible))}; it has "
            f"{place.lowest} to {place.highest}"
        )
    extra = dict.fromkeys(no_value or [], "no value")
    return replace(codes, named={**extra, **codes.named}) if extra else codes


def _input_signal(database: VehicleDatabase, name: str | None) -> SignalName | None:
    return next((item.signal for item in database.layout.input if item.name == name), None)


def _temperature_codes(database: VehicleDatabase) -> Codes | None:
    name = _input_signal(database, database.layout.temperature)
    return None if name is None else _codes(database, name, CELSIUS, "temperature")
