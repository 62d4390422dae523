"""Builds the node's core from layout, DBC and parameters; signals are looked up here, and never for each frame.

Loop guard: no message that the layout reads may be sent on the same bus, else the node would correct its own output, or
speak in the name of another control unit. By the DBC, all messages that the node sends must come from one control unit,
which sends none of the messages that are read. In each frame a bit that the node writes belongs to one signal only. A
gateway passes the branches' messages on to the other bus; only the status message is its own.
"""

import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import NamedTuple, Unpack

import can
from cantools.database.can import Message, Signal

from ecu_node.bus.adapters import Settings, connect, filters_of
from ecu_node.core.correction import AS_IT_IS, NO_FAULT, IntegerPlan, SensorFault, Signals, correction_plan
from ecu_node.core.corrector import PARAMETER_SETS, Corrector, OwnMessage, Source, StatusFields
from ecu_node.core.e2e import protection_of
from ecu_node.core.junction import HeardSignal, JunctionWatch, LiveBranch, Written
from ecu_node.core.signals import (
    AMPERE,
    VOLT,
    WATT,
    Codes,
    FrameKey,
    PlacedSignal,
    as_written,
    bit_place,
    exact_code,
    not_available_code,
    overlapping,
    placed_signal,
    read_codes,
    require_reach,
    writable_range,
)
from ecu_node.core.status import Counters, Quality, Reason, State, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import BusError, DatabaseError, LayoutError
from ecu_node.layout import Branch, SignalName, split_signal
from ecu_node.parameters import NOTHING_EXPECTED, VehicleParameters, check_fit, read_parameters

__all__ = ["InForce", "Mode", "branch_plan", "choose_parameters", "open_bus", "put_in_force", "wire"]

_NOBODY = "Vector__XXX"
"""How a DBC says that a message has no sender."""
_CLASSIC_BYTES, _FD_BYTES = 8, 64


class Mode(Enum):
    """Where corrected values go."""

    OVERLAY = "under identifiers of their own, on the same bus"
    GATEWAY = "in place of the measured ones, on the other bus"


def key_of(message: Message) -> FrameKey:
    """Return the identifier of a message of the DBC."""
    return FrameKey(message.frame_id, message.is_extended_frame)


def is_fd(message: Message) -> bool:
    """Check whether a message needs CAN FD: by its length, or because the DBC says so."""
    return bool(message.is_fd) or message.length > _CLASSIC_BYTES


def _by_key(database: VehicleDatabase, names: Iterable[SignalName | None]) -> dict[FrameKey, Message]:
    """Return the messages that carry these signals, by identifier."""
    return {key_of(message): message for message, _ in (database.signal(name) for name in names if name is not None)}


def received(database: VehicleDatabase) -> dict[FrameKey, Message]:
    """Return the messages that carry branches, their voltages and the input of the watch, by identifier."""
    layout = database.layout
    names = [name for branch in layout.branch for name in (branch.source, branch.voltage)]
    return _by_key(database, [*names, layout.watch_signal])


def rewritten(database: VehicleDatabase) -> dict[FrameKey, Message]:
    """Return the messages that a gateway rewrites, by identifier."""
    return _by_key(database, (branch.source for branch in database.layout.branch))


def transmitted(database: VehicleDatabase, mode: Mode) -> dict[FrameKey, Message]:
    """Return the messages that the node sends in its own name, by identifier; not those that a gateway rewrites."""
    return _by_key(database, (item.name for item in _written(database, mode) if item.own))


def needs_fd(database: VehicleDatabase, mode: Mode) -> list[str]:
    """Return the names of the messages, received or sent, that need CAN FD."""
    messages = {**received(database), **transmitted(database, mode)}
    return [message.name for message in messages.values() if is_fd(message)]


class _WrittenSignal(NamedTuple):
    """A signal that the node writes."""

    name: SignalName
    purpose: str
    needed: int
    """The greatest code that it must hold; 0 for a current or power."""
    largest: int
    """The greatest code that the node writes, as far as the signal's width holds it; 0 for a current or power."""
    own: bool
    """Whether the node is the sender of the whole message."""


def _written(database: VehicleDatabase, mode: Mode) -> list[_WrittenSignal]:
    """Return all signals that the node writes; a gateway writes the branches where it reads them."""
    own, status = mode is Mode.OVERLAY, database.layout.status
    found = []
    for branch in database.layout.branch:
        what = f"branch {branch.name}"
        if target := branch.corrected if own else branch.source:
            found.append(_WrittenSignal(target, what, 0, 0, own))
        if own and branch.quality:
            found.append(_WrittenSignal(branch.quality, what, Quality.INVALID, Quality.IMPLAUSIBLE, own))
    if status is not None:
        ends = {"state": max(State), "reason": max(Reason), "parameter_set": PARAMETER_SETS - 1}
        codes = {key: (end, end) for key, end in ends.items()} | {"alive_counter": (1, sys.maxsize)}
        found += [_WrittenSignal(name, "status", *codes.get(key, (0, 0)), True) for key, name in status.signals.items()]
    return found


def _check_output(database: VehicleDatabase, mode: Mode) -> None:
    """Refuse a layout with which the node would disturb the bus or itself; errors are those of :func:`wire`."""
    where, sent = database.layout.path, transmitted(database, mode)
    if not sent and mode is Mode.OVERLAY:
        raise LayoutError(
            f"{where}: nothing to publish: neither a branch with a 'corrected' signal nor a [status]; add them to DBC "
            f"and layout (the documentation's page 'Layout' has the lines), or be a gateway, which needs none: "
            f"--gateway CHANNEL"
        )
    read = received(database) | _by_key(database, (item.signal for item in database.layout.input))
    if both := [message.name for key, message in sent.items() if key in read]:
        raise LayoutError(
            f"{where}: {', '.join(both)} would be both received and sent; corrected values and status need messages "
            f"of their own"
        )

    def only_senders(messages: Iterable[Message]) -> dict[str, str]:
        """Return messages by their only sender; several senders, as of {SENDRECEIVE} in a SYM file, say nothing."""
        named = {message.name: set(message.senders) - {_NOBODY} for message in messages}
        return {sender: name for name, found in named.items() if len(found) == 1 for sender in found}

    senders, others = only_senders(sent.values()), only_senders(read.values())
    if len(senders) > 1 or others.keys() & senders.keys():
        found = ", ".join(f"{message} by {sender}" for sender, message in senders.items())
        raise LayoutError(
            f"{where}: {database.layout.dbc_path} has {found}; all corrected values and the status need to be sent by "
            f"one control unit of their own, which sends no branch and no input"
        )
    for message in sent.values():
        if message.length > _FD_BYTES:
            raise DatabaseError(
                f"{database.layout.dbc_path}: message {message.name}, which the node sends, has {message.length} "
                f"bytes; CAN FD carries at most {_FD_BYTES}"
            )
    written = _written(database, mode)
    signals = [database.signal(item.name)[1] for item in written]
    for name, purpose, needed, largest, own in written:
        message, signal = database.signal(name)
        what = f"{where}: {purpose}: signal {message.name}.{signal.name}"
        place = bit_place(signal, what)
        if place.end > message.length:
            raise DatabaseError(f"{what} ends in byte {place.end}, but the message has {message.length} bytes")
        if own and signal.multiplexer_ids is not None:
            raise DatabaseError(f"{what} is multiplexed; what the node sends in its own name must be in every frame")
        if largest:
            _check_codes(signal, needed, largest, what)
        if signals.count(signal) > 1:
            raise LayoutError(f"{what} is written twice; give each value a signal of its own")
        protection, overlapped = protection_of(database, message), overlapping(message, signal)
        if protection is not None and protection.header_mask & place.mask:
            overlapped.append("the E2E header")
        if overlapped:
            raise LayoutError(
                f"{what} overlaps {', '.join(overlapped)}, which must keep its bits when the signal is written; "
                f"correct the places in the DBC"
            )


def _check_codes(signal: Signal, needed: int, largest: int, what: str) -> None:
    """Refuse a signal that cannot hold the codes from 0 on, or that gives them other values or none by the DBC."""
    codes = read_codes(signal, None, what)
    highest = codes.place.highest
    largest = min(largest, highest)
    if highest < needed:
        raise DatabaseError(f"{what} holds at most {highest}; {needed} must fit, widen it in the DBC")
    if codes.scale != 1 or codes.offset != 0:
        raise DatabaseError(
            f"{what} has factor {signal.scale:g} and offset {signal.offset:g}; the node writes raw codes: give it "
            f"(1,0) in the DBC"
        )
    if codes.lowest > 0 or codes.highest < largest:
        raise DatabaseError(
            f"{what} has the range [{signal.minimum:g}|{signal.maximum:g}], but the node writes codes 0 to {largest}; "
            f"widen the range in the DBC"
        )


def signal_codes(
    database: VehicleDatabase,
    name: SignalName,
    units: Mapping[str, float] | None,
    what: str,
    no_value: tuple[int, ...] = (),
) -> Codes:
    """Return the codes of a signal; `no_value` are further codes that are no values.

    Values are in the base unit of `units`, such as :data:`.AMPERE`, or in the signal's own if that is None. `what`
    names the signal's use in errors.

    Raises
    ------
    DatabaseError
        If the signal cannot be read, see :func:`ecu_node.core.signals.read_codes`.
    LayoutError
        If the signal cannot have a code of `no_value`.
    """
    codes = read_codes(database.signal(name)[1], units, f"{database.layout.path}: {what}")
    place = codes.place
    if impossible := [code for code in no_value if not place.lowest <= code <= place.highest]:
        raise LayoutError(
            f"{database.layout.path}: {what}: no_value: {name} has no code {', '.join(map(str, impossible))}; it has "
            f"{place.lowest} to {place.highest}"
        )
    return replace(codes, named={**dict.fromkeys(no_value, "no value"), **codes.named})


def branch_signals(database: VehicleDatabase, branch: Branch, mode: Mode) -> Signals:
    """Return the signals that a branch is read from and written to.

    A gateway writes every branch back where it was read, an overlay node where the layout says. If nothing is published
    the source itself is the target. Errors are those of :func:`signal_codes`.
    """
    what, units = f"branch {branch.name}", AMPERE if branch.signal is not None else WATT
    source = signal_codes(database, branch.source, units, what, tuple(branch.no_value))
    is_apart = mode is Mode.OVERLAY and branch.corrected is not None
    return Signals(
        source=source,
        target=signal_codes(database, branch.corrected, units, what) if is_apart and branch.corrected else source,
        sign=branch.sign,
        voltage=signal_codes(database, branch.voltage, VOLT, what) if branch.voltage is not None else None,
    )


def branch_plan(database: VehicleDatabase, branch: Branch, fault: SensorFault, mode: Mode) -> IntegerPlan:
    """Return the plan of one branch, from measured to written codes; errors are those of ``branch_signals``."""
    return correction_plan(branch_signals(database, branch, mode), fault)


@dataclass(frozen=True, kw_only=True)
class InForce:
    """Parameters in force, or the reason why there are none and measured values are passed through."""

    parameters: VehicleParameters | None
    reason: Reason = Reason.NONE
    why_not: str | None = field(default=None, compare=False)
    """The reason in words, one line; None where there are parameters."""

    def fault(self, branch: str) -> SensorFault:
        """Return the fault that is corrected on one branch; NO_FAULT if the parameters apply none."""
        return self.parameters.fault(branch) if self.parameters is not None else NO_FAULT


def choose_parameters(path: Path, database: VehicleDatabase, vehicle: str | None) -> InForce:
    """Read parameters, and decide whether they may be applied here.

    Parameters
    ----------
    path : Path
        Parameter file.
    database : VehicleDatabase
        Layout and DBC in use.
    vehicle : str or None
        Identity of the vehicle; None: not checked.

    Returns
    -------
    InForce
        The parameters, or the reason why measured values are passed through.
    """
    where = ""  # errors of read_parameters name the file themselves
    try:
        parameters = read_parameters(path)
        where = f"{path}: "
        check_fit(parameters, database, vehicle)
    except UnfitError as error:
        return InForce(parameters=None, reason=error.reason, why_not=f"{where}{error}")
    return InForce(parameters=parameters)


def unpublished(database: VehicleDatabase, in_force: InForce, mode: Mode) -> dict[str, str]:
    """Return, by branch, a line for the log on each fault that an overlay cannot correct, for lack of a signal."""
    hidden = [branch.name for branch in database.layout.branch if mode is Mode.OVERLAY and branch.corrected is None]
    why = "the parameters apply a fault to it, but the layout has no 'corrected' for it"
    return {name: f"branch {name} is not published: {why}" for name in hidden if in_force.fault(name).applied}


def _full_scale(database: VehicleDatabase, signals: Signals) -> Fraction:
    """Return the full scale of a branch [A, or W where it is a power]."""
    largest, volts = as_written(database.layout.full_scale_a), signals.voltage
    if volts is None:
        return largest
    return largest * max(abs(volts.worth(code)) for code in (volts.lowest, volts.highest))


def narrowed(database: VehicleDatabase, mode: Mode) -> list[str]:
    """Return a warning for each corrected signal that cannot hold its measured signal's values up to full scale."""
    found = []
    for branch in database.layout.branch:
        signals = branch_signals(database, branch, mode)
        (low, high), (least, most) = (
            sorted(codes.worth(code) for code in (codes.lowest, codes.highest))
            for codes in (signals.source, signals.target)
        )
        largest = _full_scale(database, signals)
        if least > max(low, -largest) or most < min(high, largest):
            found.append(
                f"branch {branch.name}: {branch.corrected} holds {float(least):g} to {float(most):g}, but "
                f"{branch.source} {float(low):g} to {float(high):g}; values beyond are sent as the nearest end"
            )
    return found


def unsealed(database: VehicleDatabase, mode: Mode) -> list[str]:
    """Return a warning for each signal that looks like a checksum in a message that is rewritten, but in no [e2e]."""
    return [
        f"message {message.name}: signal {signal.name} looks like a checksum, but the message is in no [e2e] of the "
        f"layout, so that a corrected frame keeps the old one; if it is one, add the message to [e2e]"
        for message in rewritten(database).values()
        for signal in message.signals
        if mode is Mode.GATEWAY and database.layout.protection(message.name) is None and _is_checksum(signal.name)
    ]


def _is_checksum(name: str) -> bool:
    """Whether CRC, checksum or chk is a word of a signal's name, such as ``BatteryCRC8`` or ``chk_motor``."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])|[^A-Za-z]+", " ", name)
    return re.search(r"\b(crc|chk|(check|chk) ?sum)\b", words, re.IGNORECASE) is not None


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
        Where corrected values go, as when the corrector was built: errors of layout and DBC were raised then.
    """
    parameters = in_force.parameters
    found = parameters.branches if parameters is not None else {}
    takes = []  # prepare all before the first takes effect: either all or none
    for branch, live in zip(database.layout.branch, corrector.branches, strict=True):
        fault, said = in_force.fault(branch.name), found.get(branch.name)
        is_in_place = mode is Mode.GATEWAY or branch.corrected is None
        take = partial(
            live.take,
            fault,
            correcting=branch_plan(database, branch, fault, mode),
            passing=AS_IT_IS if is_in_place else branch_plan(database, branch, NO_FAULT, mode),
            delay_s=(said and said.delay_s) or 0.0,
            expected_since_s=now_s if said is not None else None,
        )
        takes.append(take)
    for take in takes:
        take()
    number = parameters.number if parameters is not None else 0
    expected = parameters.junction_residual if parameters is not None else NOTHING_EXPECTED
    corrector.begin(reason=in_force.reason, parameter_set=number, expected=expected)


def wire(
    database: VehicleDatabase, in_force: InForce, start_s: float, *, mode: Mode = Mode.OVERLAY, shadow: bool = False
) -> Corrector:
    """Build the node's core, with these parameters in force.

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
    LayoutError
        If nothing is published, a message of a branch or an input would be sent, the DBC says that another control
        unit sends it, or a signal that is written shares bits with another one or the E2E header.
    DatabaseError
        If a signal cannot be read or written, or its values do not fit.
    """
    _check_output(database, mode)
    layout, counters = database.layout, Counters()
    readers: dict[FrameKey, list[tuple[HeardSignal, PlacedSignal]]] = defaultdict(list)

    def read(name: SignalName, part: HeardSignal | LiveBranch) -> None:
        message, signal = database.signal(name)
        readers[key_of(message)].append((part, placed_signal(message, signal)))

    branches: dict[str, LiveBranch] = {}
    auxiliaries: dict[SignalName, HeardSignal] = {}
    for branch in layout.branch:
        signals = branch_signals(database, branch, mode)
        if mode is Mode.GATEWAY or branch.corrected is not None:
            require_reach(signals.target, _full_scale(database, signals), f"{layout.path}: branch {branch.name}")
        if branch.voltage is not None and signals.voltage is not None and branch.voltage not in auxiliaries:
            timeout_s = max(item.timeout_s for item in layout.branch if item.voltage == branch.voltage)
            auxiliaries[branch.voltage] = HeardSignal(signals.voltage, timeout_s)
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
    watch = JunctionWatch(
        list(branches.values()),
        window_s=layout.watch.window_s,
        margin_a=layout.watch_margin_a,
        full_scale_a=layout.full_scale_a,
    )
    if (name := layout.watch_signal) is not None:
        codes = signal_codes(database, name, None, "[watch] input")
        state = HeardSignal(replace(codes, named={}), layout.max_age_s)  # the name of a state is no lack of a value
        valid = (exact_code(database.signal(name)[1], value) for value in layout.watch.valid)
        watch.judge_only(state, frozenset(map(int, valid)))
        read(name, state)
    answers = _answers(database, branches) if mode is Mode.OVERLAY else {}
    corrector = Corrector(
        sources={
            key: Source(
                protection=protection_of(database, message),
                readers=readers[key],
                targets=answers.get(key, []),
                counters=counters,
            )
            for key, message in received(database).items()
        },
        branches=list(branches.values()),
        status_fields=_status_fields(database),
        watch=watch,
        counters=counters,
        shadow=shadow,
        sleep_s=layout.watch.sleep_s,
    )
    put_in_force(corrector, database, in_force, start_s, mode=mode)
    return corrector


def _own_message(database: VehicleDatabase, name: str) -> OwnMessage:
    message = database.message(name)
    protection = protection_of(database, message)
    return OwnMessage(key_of(message), message.length, fd=is_fd(message), protection=protection)


def _answers(database: VehicleDatabase, branches: Mapping[str, LiveBranch]) -> dict[FrameKey, list[OwnMessage]]:
    """Return the corrected messages of an overlay node, by the incoming messages that they answer."""
    answers: dict[FrameKey, list[OwnMessage]] = defaultdict(list)
    made: dict[str, OwnMessage] = {}
    for branch in database.layout.branch:
        if branch.corrected is not None:
            name = split_signal(branch.corrected)[0]
            message = made[name] = made.get(name) or _own_message(database, name)
            codes = branch_signals(database, branch, Mode.OVERLAY).target
            not_available = not_available_code(codes, f"{database.layout.path}: branch {branch.name}")
            quality = bit_place(database.signal(branch.quality)[1]) if branch.quality is not None else None
            message.branches[branches[branch.name]] = Written(codes.place, not_available, quality)
            for incoming in _by_key(database, [branch.source]):
                answers[incoming] += [message] * (message not in answers[incoming])
    return answers


def _status_fields(database: VehicleDatabase) -> StatusFields | None:
    """Return the status message and the places of its fields; None if the layout has no status."""
    status, where = database.layout.status, f"{database.layout.path}: status"
    if status is None:
        return None
    places, sums = {}, {}
    for key, name in status.signals.items():
        signal = database.signal(name)[1]
        if key in {"sum_measured", "sum_corrected"}:
            codes = read_codes(signal, AMPERE, where)
            require_reach(codes, as_written(database.layout.full_scale_a), where)
            lowest, highest = writable_range(codes, where)
            sums[key] = replace(codes, lowest=lowest, highest=highest), not_available_code(codes, where)
        else:
            places[key] = bit_place(signal)
    return StatusFields(_own_message(database, status.message), places, sums)


def open_bus(
    database: VehicleDatabase,
    *,
    interface: str,
    channel: str | None,
    mode: Mode,
    routed: bool = False,
    own: bool = True,
    **settings: Unpack[Settings],
) -> can.BusABC:
    """Open a bus for the node.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    mode : Mode
        An overlay node receives what it needs, a gateway everything.
    routed : bool
        Whether the kernel carries the frames that a gateway only passes on, so that it need not receive them.
    own : bool
        Whether an overlay node also receives its own messages, so as to notice another node that sends them.
    interface, channel, **settings :
        As for ``ecu_node.bus.adapters.bus_config``.

    Returns
    -------
    can.BusABC
        The bus; it does not receive what it sends.

    Raises
    ------
    BusError
        If there is no such bus, or the DBC needs CAN FD and ``fd`` is not given.
    """
    require_fd(database, mode, fd=settings.get("fd", False))
    keys = received(database).keys() | (transmitted(database, mode).keys() if own else set())
    filters = filters_of(keys) if mode is Mode.OVERLAY or routed else None
    return connect(interface, channel, filters=filters, **settings)


def require_fd(database: VehicleDatabase, mode: Mode, *, fd: bool) -> None:
    """Raise BusError if the DBC needs CAN FD and ``fd`` is not given."""
    if not fd and (names := needs_fd(database, mode)):
        raise BusError(f"{database.layout.dbc_path}: CAN FD messages ({', '.join(names)}); start with --fd")
