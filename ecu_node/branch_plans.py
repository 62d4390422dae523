"""What each branch of a layout is read from and written to, and its correction in the codes of these signals."""

from ecu_node.codes import as_written, require_reach
from ecu_node.correction import AS_IT_IS, IntegerPlan, Signals, correction_plan
from ecu_node.database import VehicleDatabase
from ecu_node.guard import Mode
from ecu_node.layout import Branch
from ecu_node.layout_signals import signal_codes
from ecu_node.sensor_fault import NO_FAULT, SensorFault
from ecu_node.units import AMPERE, VOLT, WATT

__all__ = ["branch_plan", "branch_signals", "passing_plan", "require_branch_reach"]


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
    LayoutError
        If the branch's ``no_value`` has codes that its signal has not.
    """
    units = AMPERE if branch.signal is not None else WATT
    source = signal_codes(database, branch.source, units, f"branch {branch.name}", branch.no_value)
    target = source
    if mode is Mode.OVERLAY and branch.corrected is not None:
        target = signal_codes(database, branch.corrected, units, f"branch {branch.name}")
    voltage = None
    if branch.voltage is not None:
        voltage = signal_codes(database, branch.voltage, VOLT, f"branch {branch.name}")
    return Signals(source=source, target=target, sign=branch.sign, voltage=voltage)


def branch_plan(database: VehicleDatabase, branch: Branch, fault: SensorFault, mode: Mode) -> IntegerPlan:
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
    IntegerPlan
        From measured to written codes, see :func:`ecu_node.correction.correction_plan`.

    Raises
    ------
    LayoutError, DatabaseError
        If the node cannot read or write one of the signals.
    """
    return correction_plan(branch_signals(database, branch, mode), fault)


def passing_plan(database: VehicleDatabase, branch: Branch, mode: Mode) -> IntegerPlan:
    """What is written of a branch where nothing is corrected: its code, or the same current in the target's codes."""
    if mode is Mode.GATEWAY or branch.corrected is None:
        return AS_IT_IS
    return branch_plan(database, branch, NO_FAULT, mode)


def require_branch_reach(database: VehicleDatabase, mode: Mode) -> None:
    """Refuse to write signals in which full scale cannot be written for a name amid their values.

    Raises
    ------
    DatabaseError
        If a value up to full scale has a name in the DBC, and would be read as that name.
    """
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
