"""Parameters in force: read, checked, turned into integer plans, and put in force in a node while it runs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from ecu_node.bus.guard import PARAMETER_SETS, Mode
from ecu_node.core.correction import AS_IT_IS, NO_FAULT, IntegerPlan, SensorFault, Signals, correction_plan
from ecu_node.core.corrector import Corrector
from ecu_node.core.junction import ExpectedSum
from ecu_node.core.signals import AMPERE, VOLT, WATT, Codes, as_written, read_codes, require_reach
from ecu_node.core.status import Reason, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.errors import LayoutError
from ecu_node.layout import Branch, SignalName
from ecu_node.parameters import VehicleParameters, check_fit, read_parameters

__all__ = [
    "FileSignature",
    "InForce",
    "ParameterFile",
    "ParameterSource",
    "branch_plan",
    "branch_signals",
    "choose_parameters",
    "input_signal",
    "not_published",
    "put_in_force",
    "require_branch_reach",
    "sensor_fault",
    "signal_codes",
    "signature",
]


def signal_codes(
    database: VehicleDatabase,
    name: SignalName,
    units: Mapping[str, float],
    what: str,
    no_value: list[int] | None = None,
) -> Codes:
    """Codes of a signal, with those that the layout itself says are no value.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    name : str
        The signal, as MESSAGE.SIGNAL.
    units : mapping of str to float
        One of the tables of :mod:`ecu_node.core.signals`; values come out in its base unit.
    what : str
        What the signal is for, for messages of errors.
    no_value : list of int, optional
        Codes that are no value, whatever the DBC says.

    Raises
    ------
    DatabaseError
        If the signal cannot be read, see ``ecu_node.core.signals.read_codes``.
    LayoutError
        If the signal has no such codes.
    """
    codes = read_codes(database.signal(name)[1], units, f"{database.layout.path}: {what}")
    place = codes.place
    if impossible := [code for code in no_value or [] if not place.lowest <= code <= place.highest]:
        raise LayoutError(
            f"{database.layout.path}: {what}: no_value: {name} has no code {', '.join(map(str, impossible))}; it has "
            f"{place.lowest} to {place.highest}"
        )
    extra = dict.fromkeys(no_value or [], "no value")
    return replace(codes, named={**extra, **codes.named}) if extra else codes


def input_signal(database: VehicleDatabase, name: str | None) -> SignalName | None:
    """Signal of the input of this name; None if there is none."""
    return next((item.signal for item in database.layout.input if item.name == name), None)


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
        From measured to written codes, see :func:`ecu_node.core.correction.correction_plan`.

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


@dataclass(frozen=True, kw_only=True)
class InForce:
    """Parameters in force, or the reason why there are none and measured values are passed through."""

    parameters: VehicleParameters | None
    reason: Reason = Reason.NONE


def sensor_fault(in_force: InForce, branch: str) -> SensorFault:
    """What is corrected on one branch; NO_FAULT where the parameters apply none."""
    found = in_force.parameters.branches.get(branch) if in_force.parameters is not None else None
    return SensorFault(drift=found.drift, offset_a=found.offset_a) if found is not None and found.apply else NO_FAULT


def not_published(database: VehicleDatabase, in_force: InForce) -> list[str]:
    """Branches with a fault to correct, but no signal to publish the result in; it counts in the status' sum alone."""
    names = [branch.name for branch in database.layout.branch if branch.corrected is None]
    return [name for name in names if sensor_fault(in_force, name).applied]


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
        Where corrected values go, as when the corrector was built: what can be wrong with layout and DBC was said then.
    """
    parameters = in_force.parameters
    found = parameters.branches if parameters is not None else {}
    plans = []  # all of them before the first is put in force: either all or none
    for branch in database.layout.branch:
        fault = sensor_fault(in_force, branch.name)
        plans.append((branch, fault, branch_plan(database, branch, fault, mode)))
    for (branch, fault, plan), live in zip(plans, corrector.branches, strict=True):
        delay_s = found[branch.name].delay_s if branch.name in found else None
        live.put_in_force(
            fault=fault,
            plan=plan,
            passing=passing_plan(database, branch, mode),
            delay_s=delay_s or 0.0,
            expected_since_s=now_s if branch.name in found else None,
        )
    if parameters is None:
        corrector.put_in_force(reason=in_force.reason, parameter_set=0)
        return
    residual = parameters.junction_residual
    measured_a, corrected_a = residual.about_expected()
    corrector.put_in_force(
        reason=in_force.reason,
        parameter_set=parameters.number % PARAMETER_SETS,
        expected=ExpectedSum(
            expected_a=residual.expected_a,
            predicted_worse_a=corrected_a - measured_a,
            corrected_a=corrected_a,
            sd_a=residual.corrected_sd_a,
            sd_per_a=residual.corrected_sd_per_a,
        ),
    )


FileSignature = tuple[int, int, int, int]
"""Times of change, size and number of a file."""

_LOOK_EVERY_S = 1.0
"""Between looks whether the file has changed. [s]"""


def choose_parameters(path: Path, database: VehicleDatabase, vehicle: str | None) -> tuple[InForce, str | None]:
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
    str or None
        That reason in words, one line; None if the parameters fit.
    """
    try:
        parameters = read_parameters(path)
    except UnfitError as error:
        return InForce(parameters=None, reason=error.reason), str(error)
    try:
        check_fit(parameters, database, vehicle)
    except UnfitError as error:
        return InForce(parameters=None, reason=error.reason), f"{path}: {error}"
    return InForce(parameters=parameters), None


def signature(path: Path) -> FileSignature | None:
    """Times of change, size and inode of a file, which tell whether it was changed; None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino


class ParameterSource(Protocol):
    """Where a running node has its parameters from."""

    in_force: InForce
    """What the node works with."""
    why_not: str | None
    """Why it passes measured values through; None if it has parameters."""

    def look(self, corrector: Corrector, now_s: float, *, asked: bool = False) -> bool:
        """See whether other parameters are to be in force from now on, and put them; to be called now and then."""


class ParameterFile:
    """Keeps the parameters of a running node up to date: new ones only if they fit, else the ones before stay.

    Parameters
    ----------
    path : Path
        Parameter file.
    database : VehicleDatabase
        Layout and DBC in use.
    vehicle : str or None
        Identity of the vehicle; None: not checked.
    mode : Mode
        Where corrected values go.
    say : callable
        Takes one line for the log.
    """

    def __init__(
        self, path: Path, database: VehicleDatabase, vehicle: str | None, *, mode: Mode, say: Callable[[str], None]
    ) -> None:
        self._path, self._database, self._vehicle = path, database, vehicle
        self._mode, self._say = mode, say
        self._seen = signature(path)
        self._due_s = float("-inf")
        self.in_force, self.why_not = choose_parameters(path, database, vehicle)

    def look(self, corrector: Corrector, now_s: float, *, asked: bool = False) -> bool:
        """Read the file again if it was changed; to be called now and then.

        Parameters
        ----------
        corrector : Corrector
            Where new parameters are put in force.
        now_s : float
            Now. [s]
        asked : bool
            Read it whether it was changed or not.

        Returns
        -------
        bool
            Whether new parameters are in force.
        """
        if not asked and now_s < self._due_s:
            return False
        self._due_s = now_s + _LOOK_EVERY_S
        seen = signature(self._path)
        if not asked and seen == self._seen:
            return False
        self._seen = seen
        in_force, why_not = choose_parameters(self._path, self._database, self._vehicle)
        if why_not is not None:
            corrector.counters.reload_failures += 1
            self._say(f"new parameters are not used, those before stay in force: {why_not}")
            return False
        put_in_force(corrector, self._database, in_force, now_s, mode=self._mode)
        self.in_force, self.why_not = in_force, None
        corrector.counters.reloads += 1
        assert in_force.parameters is not None
        self._say(f"parameter set {in_force.parameters.number} of vehicle {in_force.parameters.vehicle} is in force")
        return True
