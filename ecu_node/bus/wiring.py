"""From layout, DBC and parameters to the node's core: everything is looked up once, at start.

The structure depends on layout and DBC alone; the parameters are then put in force in it, see
:mod:`ecu_node.bus.in_force`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from ecu_node.bus.guard import Mode, check_output, is_fd, key_of, received
from ecu_node.bus.in_force import (
    InForce,
    branch_signals,
    input_signal,
    put_in_force,
    require_branch_reach,
    signal_codes,
)
from ecu_node.core.branch import Auxiliary, LiveBranch
from ecu_node.core.corrector import Corrector, StatusFields
from ecu_node.core.e2e import protection_of
from ecu_node.core.frames import FrameKey, Reader, Source, Target, TargetField
from ecu_node.core.junction import JunctionWatch
from ecu_node.core.signals import (
    BitPlace,
    Codes,
    as_written,
    bit_place,
    not_available_code,
    placed_signal,
    read_codes,
    require_reach,
    writable_range,
)
from ecu_node.core.status import Counters
from ecu_node.database import VehicleDatabase
from ecu_node.layout import SignalName, split_signal
from ecu_node.units import AMPERE, VOLT

__all__ = ["wire"]


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
        If the node cannot do its work with this layout and DBC, see :func:`ecu_node.bus.guard.check_output`.
    """
    check_output(database, mode)
    require_branch_reach(database, mode)
    layout = database.layout
    parts = _parts(database)
    targets = _targets(database, parts) if mode is Mode.OVERLAY else {}
    counters = Counters()
    corrector = Corrector(
        sources=_sources(database, parts, targets, counters),
        branches=list(parts.branches.values()),
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
        sleep_s=layout.watch.sleep_s,
    )
    put_in_force(corrector, database, in_force, start_s, mode=mode)
    return corrector


@dataclass(kw_only=True)
class _Parts:
    """Branches and auxiliary signals, and by which signal each is read."""

    branches: dict[str, LiveBranch]
    signals: list[tuple[SignalName, Auxiliary | LiveBranch]]
    whole: tuple[Auxiliary, frozenset[int]] | None = None
    """The input that tells whether all currents are measured, and its codes with which they are."""

    def is_whole(self, now_s: float) -> bool:
        """Whether all currents of the junction are measured now."""
        return self.whole is None or self.whole[0].code_at(now_s) in self.whole[1]


def _parts(database: VehicleDatabase) -> _Parts:
    """Make all of them."""
    layout = database.layout
    parts = _Parts(branches={}, signals=[])

    def auxiliary(name: SignalName, codes: Codes, timeout_s: float) -> Auxiliary:
        item = Auxiliary(codes, timeout_s)
        parts.signals.append((name, item))
        return item

    whole_name = input_signal(database, layout.watch.input)
    if whole_name is not None:
        unit = database.signal(whole_name)[1].unit or ""
        codes = signal_codes(database, whole_name, {unit: 1.0}, "[watch] input")
        every_code = replace(codes, named={})  # states have names, which are no lack of a value here
        valid = [(as_written(float(value)) - codes.offset) / codes.scale for value in layout.watch.valid]
        parts.whole = auxiliary(whole_name, every_code, layout.max_age_s), frozenset(map(int, valid))
    voltages: dict[SignalName, Auxiliary] = {}
    for branch in layout.branch:
        if branch.voltage is not None and branch.voltage not in voltages:
            codes = signal_codes(database, branch.voltage, VOLT, f"branch {branch.name}")
            timeout_s = max(item.timeout_s for item in layout.branch if item.voltage == branch.voltage)
            voltages[branch.voltage] = auxiliary(branch.voltage, codes, timeout_s)
    for branch in layout.branch:
        signals = branch_signals(database, branch, Mode.GATEWAY)
        live = LiveBranch(
            name=branch.name,
            codes=signals.source,
            sign=branch.sign,
            timeout_s=branch.timeout_s,
            start_s=layout.watch.start_s,
            voltage=voltages[branch.voltage] if branch.voltage is not None else None,
        )
        parts.branches[branch.name] = live
        parts.signals.append((branch.source, live))
    return parts


def _sources(
    database: VehicleDatabase, parts: _Parts, targets: Mapping[str, Target], counters: Counters
) -> dict[FrameKey, Source]:
    """Incoming messages, with who reads them and which targets answer them."""
    sources = {}
    for key, message in received(database).items():
        inside = [(name, part) for name, part in parts.signals if split_signal(name)[0] == message.name]
        readers = [Reader(part, placed_signal(message, database.signal(name)[1])) for name, part in inside]
        branches = [branch for branch in database.layout.branch if split_signal(branch.source)[0] == message.name]
        answers = dict.fromkeys(
            split_signal(branch.corrected)[0] for branch in branches if branch.corrected is not None
        )
        sources[key] = Source(
            protection=protection_of(database, message),
            readers=readers,
            targets=[targets[name] for name in answers if name in targets],
            counters=counters,
            pass_on_invalid=database.layout.on_bad_frame == "invalid",
        )
    return sources


def _targets(database: VehicleDatabase, parts: _Parts) -> dict[str, Target]:
    """Corrected messages of an overlay node, by name."""
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
