"""Fault memory: why the node fell back, kept in the state folder as a control unit keeps its trouble codes.

There is one entry per reason and branches: when first and last, how often, and the currents of the last time. An active
fault stays active, also after a restart, until the bus has slept (if a branch was silent or stuck), another parameter
set is put in force, or ``ecu-node clear`` is run.
"""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Reason
from ecu_node.documents import read_user_file, write_atomically
from ecu_node.errors import UserError
from ecu_node.update.state import state_path, time_text

_NAME = "faults.json"
_CLEARED = "faults.cleared"
"""Empty file that ``ecu-node clear`` leaves for a running node, which removes it; a fault may be in no file yet."""
_MOST_FAULTS, _LARGEST_BYTES = 64, 1_000_000
_LOOK_EVERY_S = 1.0
"""Time between checks whether somebody cleared the memory. [s]"""
_TRY_AGAIN_S = 60.0
"""Time between attempts to write what could not be written. [s]"""


class Fault(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """One entry of the fault memory."""

    reason: str
    """Name of the reason in the status message."""
    branches: list[str]
    """Branches that explain it best."""
    parameter_set: int | None
    """Number of the parameter set in force when it last occurred; None: not known."""
    first: str
    last: str
    """When it occurred first and last; ISO 8601, UTC."""
    count: int = 0
    measured_a: dict[str, float] = {}
    corrected_a: dict[str, float] = {}
    """Currents when it last occurred, positive into the junction. [A]"""
    active: bool = True
    """Whether it still keeps the node from correcting."""

    def __post_init__(self) -> None:
        if self.reason not in Reason.__members__ or not Reason[self.reason]:
            raise ValueError(f"unknown reason {self.reason!r}")


def read_faults(folder: Path) -> list[Fault]:
    """Return the entries of a state folder, the last one first.

    Raises
    ------
    UserError
        If the entries cannot be read, or the folder is none of a node.
    """
    return _read(_of_a_node(folder) / _NAME)


def clear_faults(folder: Path) -> str:
    """Forget all entries, and say how many; a running node then corrects again within a second.

    Raises
    ------
    UserError
        If the folder is none of a node.
    """
    path = _of_a_node(folder) / _NAME
    try:
        count = len(_read(path))
        found = f"{count} fault{'s' * (count > 1)} cleared" if count else "no faults stored"
    except UserError:
        found = "a fault memory that could not be read is cleared"
    path.unlink(missing_ok=True)
    with suppress(FileExistsError):
        (folder / _CLEARED).touch(exist_ok=False)  # so it follows no link
    return f"{folder}: {found}"


def _of_a_node(folder: Path) -> Path:
    """Return a folder that holds a state or faults; raise UserError if it holds neither."""
    if not ((folder / _NAME).exists() or state_path(folder).exists()):
        raise UserError(f"{folder}: neither a state nor faults there; name the folder of 'ecu-node run --state'")
    return folder


def _read(path: Path) -> list[Fault]:
    """Return the entries of a file, none if there is no such file; raise UserError if they cannot be read."""
    try:
        return msgspec.json.decode(read_user_file(path, largest_bytes=_LARGEST_BYTES), type=list[Fault])
    except FileNotFoundError:
        return []
    except (OSError, msgspec.DecodeError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"{path}: cannot read the fault memory: {why}; 'ecu-node clear' begins a new one") from None


def faults_text(faults: list[Fault]) -> str:
    """Return the entries as readable text."""
    lines = []
    for fault in faults:
        which = f" ({' or '.join(fault.branches)})" if fault.branches else ""
        lines.append(
            f"{fault.reason}{which}, {'active' if fault.active else 'over'}: {fault.count} times, first {fault.first}, "
            f"last {fault.last}, parameter set {fault.parameter_set}"
        )
        lines += [
            f"  {name}: measured {value:+.1f} A, corrected {fault.corrected_a.get(name, value):+.1f} A"
            for name, value in fault.measured_a.items()
        ]
    return "\n".join(lines) or "no faults"


class FaultMemory:
    """Keeps the faults of a running node.

    Parameters
    ----------
    corrector : Corrector
        Core; an active fault is latched again once the parameter set that it occurred with is in force. If the memory
        cannot be read, the gravest reason is latched, as nobody knows what was.
    folder : Path
        State folder.
    say : callable
        Takes one line for the log.
    background : Executor
        Runs the writing, as a slow disk must not hold up the bus.
    """

    def __init__(self, corrector: Corrector, folder: Path, say: Callable[[str], None], background: Executor) -> None:
        self._corrector, self._folder, self._say, self._background = corrector, folder, say, background
        self._due_s = self._tried_s = float("-inf")
        self._written: Future[bool] | None = None
        """Result of the last write: whether the file now holds the faults; None before the first one."""
        try:
            if not folder.is_dir():  # such as one that is not mounted yet
                raise UserError(f"{folder}: no such state folder")
            self._faults = _read(folder / _NAME)
        except UserError as error:
            say(f"{error}; until then measured values are passed through")
            reason, now = Reason.SUM_IMPLAUSIBLE.name, time_text(datetime.now(UTC))
            self._faults = [Fault(reason=reason, branches=[], parameter_set=None, first=now, last=now, count=1)]
        self._before = corrector.latched, corrector.latched_branches
        self._latch_again()

    def _latch_again(self) -> None:
        """Latch what was active when the node last ended, unless something else keeps it from correcting."""
        corrector = self._corrector
        if corrector.reason or corrector.latched:
            return
        for fault in self._faults:
            if fault.active and fault.parameter_set in {None, corrector.parameter_set}:
                corrector.latch(Reason[fault.reason], fault.branches)
                self._before = corrector.latched, corrector.latched_branches
                fault.parameter_set = corrector.parameter_set
                return

    def look(self, now_s: float) -> None:
        """Record a change of what is latched since the last call, and see whether the memory was cleared."""
        corrector = self._corrector
        if now_s >= self._due_s and (self._written is None or self._written.done()):
            self._due_s = now_s + _LOOK_EVERY_S
            if self._is_cleared():
                self._faults, self._written = [], None
                if corrector.latched:
                    corrector.release()
                self._before = corrector.latched, corrector.latched_branches
            elif self._written is not None and not self._written.result() and now_s - self._tried_s >= _TRY_AGAIN_S:
                self._keep(now_s)
        found = corrector.latched, corrector.latched_branches
        if found != self._before:
            self._before = found
            for fault in self._faults:
                fault.active = False
            if corrector.latched:
                self._add(Reason(corrector.latched).name, list(corrector.latched_branches))
            self._keep(now_s)
        self._latch_again()

    def _is_cleared(self) -> bool:
        """Take away the file that ``ecu-node clear`` leaves; return whether it was there."""
        try:
            (self._folder / _CLEARED).unlink()
            (self._folder / _NAME).unlink(missing_ok=True)  # it was written at the same time
        except OSError:  # a folder that is gone, or on a broken disk, says nothing
            return False
        return True

    def _keep(self, now_s: float) -> None:
        """Have the entries written in the background."""
        self._tried_s = now_s
        content = msgspec.json.format(msgspec.json.encode(self._faults), indent=2) + b"\n"
        self._written = self._background.submit(self._write, content)

    def _add(self, reason: str, branches: list[str]) -> None:
        """Put a fault that occurs now first in the list: its old entry, counted once more, or a new one."""
        corrector, now = self._corrector, time_text(datetime.now(UTC))
        found = [item for item in self._faults if (item.reason, item.branches) == (reason, branches)]
        fault = found[0] if found else Fault(reason=reason, branches=branches, parameter_set=0, first=now, last=now)
        fault.parameter_set, fault.last, fault.active = corrector.parameter_set, now, True
        fault.count += 1
        fault.measured_a = {name: round(pair[0], 3) for name, pair in corrector.watch.currents_a.items()}
        fault.corrected_a = {name: round(pair[1], 3) for name, pair in corrector.watch.currents_a.items()}
        self._faults = [fault, *(item for item in self._faults if item is not fault)][:_MOST_FAULTS]

    def _write(self, content: bytes) -> bool:
        """Write the file; return whether it is written."""
        try:
            write_atomically(self._folder / _NAME, content)
        except OSError as error:
            self._say(f"{self._folder / _NAME}: cannot keep the fault: {error.strerror}; tried again each minute")
            return False
        return True
