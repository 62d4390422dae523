"""What the C code does, before it is text: what the node would do as a gateway, branch by branch, message by message.

A branch that the node passes through has no plan. One that it corrects has a list of integer plans and a rule which of
them holds: the only one, by the sign of the true current, or by the code of the temperature.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from cantools.database.can import Message

from calibrator.errors import ExportError
from calibrator.export.checked import Checked
from ecu_node.bits import PlacedSignal, placed_signal
from ecu_node.branch_plans import branch_plan, branch_signals
from ecu_node.codes import Codes, read_codes
from ecu_node.correction import IntegerPlan, SignPlan, TemperaturePlans
from ecu_node.guard import Mode, rewritten
from ecu_node.layout import Branch, SignalName, split_signal
from ecu_node.units import CELSIUS, VOLT
from ecu_node.wiring import wire

__all__ = ["CBranch", "CInput", "CMessage", "CProgram", "SignRule", "c_program"]

MOST_TEMPERATURES = 1024
"""Codes of a temperature signal that get a row of 32 bytes each: 32 KiB of constants for a sensor."""


@dataclass(frozen=True, kw_only=True)
class CInput:
    """A signal that corrections need beside the current: a voltage or a temperature."""

    name: str
    """``Message_Signal``"""
    message: Message
    placed: PlacedSignal
    codes: Codes


@dataclass(frozen=True, kw_only=True)
class SignRule:
    """The first of two plans holds if code * of_code + voltage_code * of_voltage + constant >= 0, else the second."""

    of_code: int
    of_voltage: int
    constant: int


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
    voltage, temperature : CInput or None
        The voltage of a power; the temperature, if the plans depend on it.
    plans : tuple of IntegerPlan or None
        None in it: passes through at that temperature. Empty: always.
    rule : SignRule, int or None
        Which plan holds: by sign; by temperature, from this code of it on; or None, the only one.
    """

    name: str
    signal: str
    codes: Codes
    placed: PlacedSignal
    voltage: CInput | None = None
    temperature: CInput | None = None
    plans: tuple[IntegerPlan | None, ...] = ()
    rule: SignRule | int | None = None

    @property
    def inputs(self) -> tuple[CInput, ...]:
        """What its function takes beside the code."""
        return tuple(item for item in (self.voltage, self.temperature) if item is not None)

    @property
    def needs_voltage(self) -> bool:
        """Whether some plan, or the rule, depends on the voltage."""
        by_rule = isinstance(self.rule, SignRule) and self.rule.of_voltage != 0
        return by_rule or any(plan is not None and plan.voltage_gain != 0 for plan in self.plans)


@dataclass(frozen=True, kw_only=True)
class CMessage:
    """One message that is rewritten."""

    message: Message
    branches: tuple[CBranch, ...]

    @property
    def inputs(self) -> tuple[CInput, ...]:
        """What its function takes beside the payload."""
        return tuple({item.name: item for branch in self.branches for item in branch.inputs}.values())


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
        return tuple({item.name: item for branch in self.branches for item in branch.inputs}.values())


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
        If a temperature signal has too many codes, a signal is too wide, or two names would be one in C.
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
    _require_own_names([item for branch in branches for item in branch.inputs])
    return program


def _branch(checked: Checked, branch: Branch) -> CBranch:
    database, fault = checked.database, checked.fault(branch.name)
    signals = branch_signals(database, branch, Mode.GATEWAY)
    voltage = None if branch.voltage is None else _input(checked, branch.voltage, VOLT)
    found = CBranch(
        name=branch.name,
        signal=branch.source,
        codes=signals.source,
        placed=placed_signal(*database.signal(branch.source)),
        voltage=voltage,
    )
    if not fault.applied:
        return found
    match branch_plan(database, branch, fault, Mode.GATEWAY):
        case IntegerPlan() as plan:
            return replace(found, plans=(plan,))
        case SignPlan() as plan:
            return replace(found, plans=(plan.positive, plan.negative), rule=_sign_rule(plan))
        case TemperaturePlans() as plan:
            return _by_temperature(found, plan, _temperature(checked))


def _by_temperature(branch: CBranch, plan: TemperaturePlans, temperature: CInput) -> CBranch:
    codes = temperature.codes
    rows = range(codes.lowest, codes.highest + 1)
    if len(rows) > MOST_TEMPERATURES:
        raise ExportError(
            f"branch {branch.name}: its temperature signal {codes.name} has {len(rows)} codes in its range, and C gets "
            f"a plan for each; at most {MOST_TEMPERATURES} are expected, give it its true range in the DBC"
        )
    plans = tuple(plan.at(code) if codes.is_value(code) else None for code in rows)
    return replace(branch, temperature=temperature, plans=plans, rule=rows.start)


def _sign_rule(plan: SignPlan) -> SignRule:
    """The rule in lowest terms; without a voltage it is a threshold, at the last code for which it holds."""
    of_code, of_voltage, constant = plan.weights
    if of_voltage == 0:
        return SignRule(of_code=1 if of_code > 0 else -1, of_voltage=0, constant=constant // abs(of_code))
    common = math.gcd(of_code, of_voltage, constant)
    return SignRule(of_code=of_code // common, of_voltage=of_voltage // common, constant=constant // common)


def _temperature(checked: Checked) -> CInput:
    layout = checked.database.layout
    (name,) = (item.signal for item in layout.input if item.name == layout.temperature)
    return _input(checked, name, CELSIUS)


def _input(checked: Checked, name: SignalName, units: Mapping[str, float]) -> CInput:
    message, signal = checked.database.signal(name)
    return CInput(
        name="_".join(split_signal(name)),
        message=message,
        placed=placed_signal(message, signal),
        codes=read_codes(signal, units, name),
    )


def _require_own_names(inputs: Sequence[CInput]) -> None:
    seen: dict[str, CInput] = {}
    for item in inputs:
        other = seen.setdefault(item.name, item)
        if (other.message.name, other.codes.name) != (item.message.name, item.codes.name):
            raise ExportError(f"{item.name}: two signals would have this name in C; rename one of them in the DBC")
