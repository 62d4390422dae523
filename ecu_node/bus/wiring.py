"""From layout, DBC and parameters to the node's core: everything is looked up once, at start.

The structure depends on layout and DBC alone; the parameters are then put in force in it, see
:mod:`ecu_node.bus.in_force`.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

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
from ecu_node.core.frames import Reader, Source, Target, TargetField
from ecu_node.core.junction import JunctionWatch
from ecu_node.core.signals import (
    AMPERE,
    Codes,
    FrameKey,
    as_written,
    bit_place,
    exact_code,
    not_available_code,
    placed_signal,
    read_codes,
    require_reach,
    usual_unit,
    writable_range,
)
from ecu_node.core.status import Counters
from ecu_node.database import VehicleDatabase
from ecu_node.layout import SignalName, split_signal

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
    layout, counters = database.layout, Counters()
    readers: dict[FrameKey, list[Reader]] = defaultdict(list)

    def read(name: SignalName, part: Auxiliary | LiveBranch) -> None:
        message, signal = database.signal(name)
        readers[key_of(message)].append(Reader(part, placed_signal(message, signal)))

    branches: dict[str, LiveBranch] = {}
    auxiliaries: dict[SignalName, Auxiliary] = {}
    for branch in layout.branch:
        signals = branch_signals(database, branch, Mode.GATEWAY)
        if branch.voltage is not None and signals.voltage is not None and branch.voltage not in auxiliaries:
            timeout_s = max(item.timeout_s for item in layout.branch if item.voltage == branch.voltage)
            auxiliaries[branch.voltage] = Auxiliary(signals.voltage, timeout_s)
            read(branch.voltage, auxiliaries[branch.voltage])
        branches[branch.name] = LiveBranch(
            name=branch.name,
            codes=signals.source,
            sign=branch.sign,
            timeout_s=branch.timeout_s,
            start_s=layout.watch.start_s,
            voltage=auxiliaries[branch.voltage] if branch.voltage is not None else None,
        )
        read(branch.source, branches[branch.name])
    state = _state_input(database)
    if state is not None:
        read(state.name, state.live)
    answers = _answers(database, branches) if mode is Mode.OVERLAY else {}
    corrector = Corrector(
        sources={
            key: Source(
                protection=protection_of(database, message),
                readers=readers[key],
                targets=answers.get(key, []),
                counters=counters,
                pass_on_invalid=layout.on_bad_frame == "invalid",
            )
            for key, message in received(database).items()
        },
        branches=list(branches.values()),
        status_fields=_status_fields(database),
        watch=JunctionWatch(
            list(branches.values()),
            window_s=layout.watch.window_s,
            margin_a=layout.watch_margin_a,
            full_scale_a=layout.full_scale_a,
            is_whole=lambda now_s: state is None or state.live.code_at(now_s) in state.valid,
        ),
        counters=counters,
        shadow=shadow,
        sleep_s=layout.watch.sleep_s,
    )
    put_in_force(corrector, database, in_force, start_s, mode=mode)
    return corrector


class _StateInput(NamedTuple):
    """The input that tells whether all currents of the junction are measured."""

    name: SignalName
    live: Auxiliary
    valid: frozenset[int]
    """Its codes with which they are."""


def _state_input(database: VehicleDatabase) -> _StateInput | None:
    layout = database.layout
    name = input_signal(database, layout.watch.input)
    if name is None:
        return None
    _, signal = database.signal(name)
    codes = signal_codes(database, name, {usual_unit(signal.unit or ""): 1.0}, "[watch] input")
    every_code = replace(codes, named={})  # states have names, which are no lack of a value here
    valid = frozenset(int(exact_code(signal, value)) for value in layout.watch.valid)
    return _StateInput(name, Auxiliary(every_code, layout.max_age_s), valid)


def _answers(database: VehicleDatabase, branches: Mapping[str, LiveBranch]) -> dict[FrameKey, list[Target]]:
    """Corrected messages of an overlay node, by the incoming messages that they answer."""
    answers: dict[FrameKey, list[Target]] = defaultdict(list)
    corrected = [(split_signal(branch.corrected)[0], branch) for branch in database.layout.branch if branch.corrected]
    for name in dict.fromkeys(name for name, _ in corrected):
        message, inside = database.message(name), [branch for other, branch in corrected if other == name]
        fields = []
        for branch in inside:
            codes = branch_signals(database, branch, Mode.OVERLAY).target
            not_available = not_available_code(codes, f"{database.layout.path}: branch {branch.name}")
            quality = bit_place(database.signal(branch.quality)[1]) if branch.quality is not None else None
            fields.append(
                TargetField(
                    branch=branches[branch.name], place=codes.place, not_available=not_available, quality=quality
                )
            )
        target = Target(
            key=key_of(message),
            length=message.length,
            fd=is_fd(message),
            fields=fields,
            protection=protection_of(database, message),
        )
        for incoming in dict.fromkeys(key_of(database.signal(branch.source)[0]) for branch in inside):
            answers[incoming].append(target)
    return answers


def _status_fields(database: VehicleDatabase) -> StatusFields | None:
    status = database.layout.status
    if status is None:
        return None
    message = database.message(status.message)
    signals = {key: database.signal(name)[1] for key, name in status.signals.items()}
    places = {key: bit_place(signal) for key, signal in signals.items()}

    def current(key: str) -> tuple[Codes, int] | None:
        if key not in signals:
            return None
        where = f"{database.layout.path}: status"
        codes = read_codes(signals[key], AMPERE, where)
        require_reach(codes, as_written(database.layout.full_scale_a), where)
        lowest, highest = writable_range(codes, where)
        return replace(codes, lowest=lowest, highest=highest), not_available_code(codes, where)

    return StatusFields(
        key=key_of(message),
        length=message.length,
        fd=is_fd(message),
        protection=protection_of(database, message),
        state=places["state"],
        reason=places["reason"],
        parameter_set=places.get("parameter_set"),
        alive_counter=places.get("alive_counter"),
        sum_measured=current("sum_measured"),
        sum_corrected=current("sum_corrected"),
    )
