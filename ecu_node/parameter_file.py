"""The parameter file of a running node: read at start, and again when it was changed or the node is told to."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from ecu_node.corrector import Corrector
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UnfitError
from ecu_node.guard import Mode
from ecu_node.in_force import InForce, put_in_force
from ecu_node.parameter_fit import check_fit
from ecu_node.parameters import read_parameters

__all__ = ["FileSignature", "ParameterFile", "ParameterSource", "choose_parameters", "signature"]

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
    """What is another one if a file was changed; None if there is none."""
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
