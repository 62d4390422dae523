"""What the node receives and sends, and the checks that keep the two apart.

Loop guard: no message that the layout reads may be sent on the same bus, else the node would correct its own output, or
speak in the name of another control unit; and by the DBC all that is sent comes from one control unit, which sends
nothing that is read. And each bit the node sends belongs to one signal only. A gateway sends the branches' messages on,
on the other bus, and in its own name the status alone.
"""

from collections.abc import Iterator, Mapping
from enum import Enum
from typing import NamedTuple

from cantools.database.can import Message, Signal

from ecu_node.core.e2e import protection_of
from ecu_node.core.signals import FrameKey, bit_place
from ecu_node.core.status import Quality, Reason, State
from ecu_node.database import VehicleDatabase
from ecu_node.errors import DatabaseError, LayoutError

__all__ = [
    "PARAMETER_SETS",
    "Mode",
    "check_output",
    "is_fd",
    "key_of",
    "needs_fd",
    "received",
    "rewritten",
    "transmitted",
]


PARAMETER_SETS = 256
"""The status publishes the number of the parameter set modulo this."""

_NOBODY = "Vector__XXX"
"""How a DBC says that a message has no sender."""
_CLASSIC_BYTES = 8


class Mode(Enum):
    """Where corrected values go."""

    OVERLAY = "under identifiers of their own, on the same bus"
    GATEWAY = "in place of the measured ones, on the other bus"


def key_of(message: Message) -> FrameKey:
    """Identifier of a message of the DBC."""
    return FrameKey(message.frame_id, message.is_extended_frame)


def is_fd(message: Message) -> bool:
    """Whether only CAN FD can carry a message, or the DBC says that it does."""
    return bool(message.is_fd) or message.length > _CLASSIC_BYTES


def received(database: VehicleDatabase) -> dict[FrameKey, Message]:
    """Messages that carry the branches and what else the node needs of the vehicle, by identifier."""
    layout = database.layout
    names = [name for branch in layout.branch for name in (branch.source, branch.voltage) if name is not None]
    names += [item.signal for item in layout.input if item.name == layout.watch.input]
    return {key_of(message): message for message, _ in map(database.signal, names)}


def rewritten(database: VehicleDatabase) -> dict[FrameKey, Message]:
    """Messages that a gateway rewrites, by identifier."""
    pairs = (database.signal(branch.source) for branch in database.layout.branch)
    return {key_of(message): message for message, _ in pairs}


def transmitted(database: VehicleDatabase, mode: Mode) -> dict[FrameKey, Message]:
    """Messages that the node sends in its own name, by identifier."""
    messages = [item.message for item in _written(database, mode) if item.own]
    if database.layout.status is not None:
        messages.append(database.message(database.layout.status.message))
    return {key_of(message): message for message in messages}


def needs_fd(database: VehicleDatabase, mode: Mode) -> list[str]:
    """Names of the messages, received or sent, that need CAN FD."""
    messages = {**received(database), **transmitted(database, mode)}
    return [message.name for message in messages.values() if is_fd(message)]


class _Written(NamedTuple):
    """A signal that the node writes, and what for."""

    message: Message
    signal: Signal
    purpose: str
    largest: int
    """The greatest code it must hold."""
    own: bool = True
    """Whether the whole message is the node's."""


def _written(database: VehicleDatabase, mode: Mode) -> Iterator[_Written]:
    """All signals that the node writes; a gateway writes the branches where it reads them."""
    for branch in database.layout.branch:
        places = ((branch.corrected, 0), (branch.quality, Quality.INVALID))
        for name, largest in places if mode is Mode.OVERLAY else ((branch.source, 0),):
            if name is not None:
                yield _Written(*database.signal(name), f"branch {branch.name}", largest, mode is Mode.OVERLAY)
    status = database.layout.status
    if status is not None:
        fields = (
            (status.state, max(State)),
            (status.reason, Reason.ON_TRIAL),
            (status.parameter_set, PARAMETER_SETS - 1),
            (status.alive_counter, 1),
            (status.sum_measured, 0),
            (status.sum_corrected, 0),
        )
        for name, largest in fields:
            if name is not None:
                yield _Written(*database.signal(f"{status.message}.{name}"), "status", largest)


def check_output(database: VehicleDatabase, mode: Mode) -> None:
    """Refuse a layout with which the node would disturb the bus or itself.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    mode : Mode
        Where corrected values go.

    Raises
    ------
    LayoutError
        If nothing is published, a message of a branch or an input would be sent, the DBC says that another control
        unit sends it, or two signals are written in one place.
    DatabaseError
        If a signal to write does not fit its message or its values do not fit the signal.
    """
    where = database.layout.path
    sent = transmitted(database, mode)
    if not sent and mode is Mode.OVERLAY:
        raise LayoutError(
            f"{where}: nothing to publish: neither a branch with a 'corrected' signal nor a [status]; add them to DBC "
            f"and layout (the documentation's page 'Layout' has the lines), or be a gateway, which needs none: "
            f"--gateway CHANNEL"
        )
    _require_own_messages(database, sent)
    taken: dict[FrameKey, int] = {}
    for item in _written(database, mode):
        _check_place(item)
        key, mask = key_of(item.message), bit_place(item.signal).mask
        if key not in taken:
            protection = protection_of(database, item.message)
            taken[key] = protection.header_mask if protection is not None else 0
        if taken[key] & mask and item.signal.multiplexer_ids is None:
            raise LayoutError(
                f"{where}: {item.purpose}: {item.message.name}.{item.signal.name} is written twice, or overlaps "
                f"another signal that is written, or the E2E header"
            )
        taken[key] |= mask


def _require_own_messages(database: VehicleDatabase, sent: Mapping[FrameKey, Message]) -> None:
    """Refuse to send what the layout reads, or what the DBC says is not sent by one control unit of its own."""
    where = database.layout.path
    inputs = (database.signal(item.signal)[0] for item in database.layout.input)
    read = {**received(database), **{key_of(message): message for message in inputs}}
    if both := [message.name for key, message in sent.items() if key in read]:
        raise LayoutError(
            f"{where}: {', '.join(both)} would be both received and sent; corrected values and status need messages "
            f"of their own"
        )
    others = {sender for message in read.values() for sender in message.senders} - {_NOBODY}
    senders = {name: message.name for message in sent.values() for name in message.senders if name != _NOBODY}
    if len(senders) > 1 or others & senders.keys():
        found = ", ".join(f"{message} by {sender}" for sender, message in senders.items())
        raise LayoutError(
            f"{where}: {database.layout.dbc_path} has {found}; all corrected values and the status need to be sent by "
            f"one control unit of their own, which sends no branch and no input"
        )


def _check_place(item: _Written) -> None:
    place = bit_place(item.signal)
    what = f"{item.purpose}: signal {item.message.name}.{item.signal.name}"
    if place.end > item.message.length:
        raise DatabaseError(f"{what} ends in byte {place.end}, but the message has {item.message.length} bytes")
    if item.own and item.signal.multiplexer_ids is not None:
        raise DatabaseError(f"{what} is multiplexed; what the node sends in its own name must be in every frame")
    if place.highest < item.largest:
        raise DatabaseError(f"{what} holds at most {place.highest}; {item.largest} must fit, widen it in the DBC")
