"""What the C code does, before it is text: what the node would do as a gateway, branch by branch, message by message.

A branch that the node passes through has no plan; one that it corrects has one integer plan.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from cantools.database.can import Message

from calibrator.errors import ExportError
from calibrator.export.checked import Checked
from ecu_node.bus.guard import Mode, rewritten
from ecu_node.bus.in_force import branch_plan, branch_signals
from ecu_node.bus.wiring import wire
from ecu_node.core.correction import IntegerPlan
from ecu_node.core.signals import VOLT, Codes, PlacedSignal, placed_signal, read_codes
from ecu_node.layout import Branch, SignalName, split_signal

__all__ = ["CBranch", "CInput", "CMessage", "CProgram", "c_program"]


@dataclass(frozen=True, kw_only=True)
class CInput:
    """A signal that corrections need beside the current: a voltage."""

    name: str
    """``Message_Signal``"""
    message: Message
    placed: PlacedSignal
    codes: Codes


@dataclass(frozen=True, kw_only=True)
class CBranch:
    """One branch.

    Attributes
    ----------
    name, signal : str
        In the layout; ``Message.Signal``.
    codes : Codes
        Of the signal.
    placed : PlacedSignal
        Where it stands.
    voltage : CInput or None
        The voltage of a power.
    plan : IntegerPlan or None
        None: passes through.
    """

    name: str
    signal: str
    codes: Codes
    placed: PlacedSignal
    voltage: CInput | None = None
    plan: IntegerPlan | None = None


@dataclass(frozen=True, kw_only=True)
class CMessage:
    """One message that is rewritten."""

    message: Message
    branches: tuple[CBranch, ...]

    @property
    def inputs(self) -> tuple[CInput, ...]:
        """What its function takes beside the payload."""
        return _voltages(self.branches)


@dataclass(frozen=True, kw_only=True)
class CProgram:
    """All of it.

    Attributes
    ----------
    checked : Checked
        The parameter file.
    branches : tuple of CBranch
        All branches of the layout.
    messages : tuple of CMessage
        All messages that carry a branch.
    """

    checked: Checked
    branches: tuple[CBranch, ...]
    messages: tuple[CMessage, ...]

    @property
    def inputs(self) -> tuple[CInput, ...]:
        """Everything that some function takes."""
        return _voltages(self.branches)


def _voltages(branches: Sequence[CBranch]) -> tuple[CInput, ...]:
    """The voltages of some branches, each once."""
    return tuple({branch.voltage.name: branch.voltage for branch in branches if branch.voltage is not None}.values())


def c_program(checked: Checked) -> CProgram:
    """Find out what the node would do as a gateway.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    CProgram
        The same for C.

    Raises
    ------
    LayoutError, DatabaseError
        If the node refuses layout or DBC.
    ExportError
        If a signal is too wide, or two names would be one in C.
    """
    database = checked.database
    wire(database, checked.in_force, start_s=0.0, mode=Mode.GATEWAY)
    branches = tuple(_branch(checked, branch) for branch in database.layout.branch)
    messages = tuple(
        CMessage(
            message=message,
            branches=tuple(item for item in branches if split_signal(item.signal)[0] == message.name),
        )
        for message in rewritten(database).values()
    )
    program = CProgram(checked=checked, branches=branches, messages=messages)
    _require_own_names([branch.voltage for branch in branches if branch.voltage is not None])
    return program


def _branch(checked: Checked, branch: Branch) -> CBranch:
    database, fault = checked.database, checked.fault(branch.name)
    signals = branch_signals(database, branch, Mode.GATEWAY)
    return CBranch(
        name=branch.name,
        signal=branch.source,
        codes=signals.source,
        placed=placed_signal(*database.signal(branch.source)),
        voltage=None if branch.voltage is None else _voltage(checked, branch.voltage),
        plan=branch_plan(database, branch, fault, Mode.GATEWAY) if fault.applied else None,
    )


def _voltage(checked: Checked, name: SignalName) -> CInput:
    message, signal = checked.database.signal(name)
    return CInput(
        name="_".join(split_signal(name)),
        message=message,
        placed=placed_signal(message, signal),
        codes=read_codes(signal, VOLT, name),
    )


def _require_own_names(inputs: Sequence[CInput]) -> None:
    seen: dict[str, CInput] = {}
    for item in inputs:
        other = seen.setdefault(item.name, item)
        if (other.message.name, other.codes.name) != (item.message.name, item.codes.name):
            raise ExportError(f"{item.name}: two signals would have this name in C; rename one of them in the DBC")
