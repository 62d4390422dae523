"""Parameters of a running node: in force, on trial, and how a trial puts them in force. Works without python-tuf."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

from msgspec.structs import replace

from ecu_node.bus.wiring import InForce, Mode, put_in_force
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Reason, TrustError, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.documents import signature
from ecu_node.errors import UserError
from ecu_node.parameters import VehicleParameters, check_fit
from ecu_node.update.state import (
    ParameterSet,
    VehicleState,
    add_decision,
    locked,
    read_state,
    require_not_expired,
    state_path,
    write_state,
)
from ecu_node.update.trial import ParameterTrial, TrialResult

__all__ = ["ParameterStore", "conclude", "end_expired"]

_LOOK_EVERY_S = 1.0
"""Time between checks whether the state has changed, or what is in force has expired. [s]"""
_RETRY_EVERY_S = 60.0
"""Time between attempts to begin a trial (the clock may not be set yet) or to write a decision (disk full). [s]"""
_SURELY_EXPIRED = timedelta(minutes=1)
"""How long a set must be expired to be removed for good: a clock may jump ahead for a moment before it is set."""


def conclude(folder: Path, tried: ParameterSet, *, passed: bool, text: str, now: datetime) -> VehicleState:
    """End a trial: put the set in force, or drop it. If another process holds the lock, raise an error at once.

    Parameters
    ----------
    folder : Path
        State folder of the vehicle.
    tried : ParameterSet
        The set that was on trial.
    passed : bool
        Whether the set passed its trial; even then it is not used if it has expired meanwhile.
    text : str
        What was seen, for the log.
    now : datetime
        Time of day.

    Returns
    -------
    VehicleState
        The new state; unchanged if another set is on trial by now.

    Raises
    ------
    UserError
        If another process holds the lock, or state or log of decisions cannot be read or written.
    """
    with locked(folder, wait=False):
        state = read_state(folder)
        if state.on_trial != tried:
            return state
        latest, event = max(now, state.latest), "in force" if passed else "failed"
        try:
            require_not_expired(tried, state, now)
        except TrustError as error:
            # A clock that jumps ahead for a moment must not be believed for ever: an update may bring the set again.
            latest, text, event = state.latest, str(error), "expired" if passed else "failed"
        if event == "in force":
            state = replace(state, in_force=tried, before=state.in_force, failed=None, ended=None)
        elif event == "failed":
            state = replace(state, failed=tried)
        state = replace(state, on_trial=None, latest=latest)
        write_state(folder, state)
        add_decision(folder, event, f"{tried}: {text}", now)
    return state


def end_expired(folder: Path, expired: ParameterSet, now: datetime) -> VehicleState:
    """Take an expired set out of the state for good: a clock that is set back later does not bring it back.

    Returns and errors are those of :func:`conclude`.
    """
    with locked(folder, wait=False):
        state = read_state(folder)
        if state.in_force != expired:
            return state
        state = replace(state, in_force=None, before=None, ended="expired")
        write_state(folder, state)
        add_decision(folder, "expired", str(expired), now)
    return state


class ParameterStore:
    """Puts in force on a running node what the state folder of its vehicle says, and runs the trials of new sets.

    Parameters
    ----------
    folder : Path
        State folder of the vehicle.
    database : VehicleDatabase
        Layout and DBC in use.
    mode : Mode
        Where corrected values go.
    say : callable
        Takes one line for the log.
    now : callable
        Returns the time of day.
    vehicle : str or None
        Identity of the vehicle, if it is also known from elsewhere; parameters of another one are not used.
    background : Executor
        Runs the writing of decisions: a slow disk may take seconds, and the bus must not wait.
    """

    def __init__(
        self,
        folder: Path,
        database: VehicleDatabase,
        *,
        mode: Mode,
        say: Callable[[str], None],
        now: Callable[[], datetime],
        vehicle: str | None = None,
        background: Executor,
    ) -> None:
        self._folder, self._database, self._mode, self._say, self._now = folder, database, mode, say, now
        self._vehicle, self._background = vehicle, background
        self._due_s = self._retry_due_s = float("-inf")
        self._state: VehicleState | None = None
        self._seen = signature(state_path(folder))
        self._unread: str | None = None
        self._fitting: tuple[ParameterSet, VehicleParameters] | None = None
        self._tried: ParameterSet | None = None
        self._trial: ParameterTrial | None = None
        self._result: TrialResult | None = None
        self._no_trial: Reason | None = None
        self._expired_since: datetime | None = None
        self._writing: Future[VehicleState] | None = None
        try:
            self._state = read_state(folder)
        except TrustError as error:
            self.in_force = InForce(parameters=None, reason=error.reason, why_not=str(error))
            self._unread = str(error)
        else:
            self.in_force = self._in_force(self._state)

    def look(self, corrector: Corrector, now_s: float) -> bool:
        """See whether a trial has ended, the state was changed, or a set has expired.

        Call it at each look at the junction.

        Parameters
        ----------
        corrector : Corrector
            Core in which new parameters are put in force.
        now_s : float
            Now. [s]

        Returns
        -------
        bool
            Whether the parameters in force have changed, or have ended.
        """
        self._finish_writing(now_s)
        self._try(corrector, now_s)
        if now_s < self._due_s:
            return False
        self._due_s = now_s + _LOOK_EVERY_S
        if self._writing is None:
            self._read_again()
        if self._state is None:
            return False
        self._end_expired(self._state, now_s)
        in_force = self._in_force(self._state)
        if in_force == self.in_force:
            return False
        put_in_force(corrector, self._database, in_force, now_s, mode=self._mode)
        corrector.counters.reloads += 1
        self.in_force = in_force
        if in_force.parameters is not None:
            self._say(f"{self._state.in_force} of vehicle {self._state.vehicle} is in force")
        else:
            self._say(f"passing measured values through: {in_force.why_not}")
        return True

    def _read_again(self) -> None:
        """Read the state if its file was changed, or could not be read the last time; it may hold a revocation."""
        seen = signature(state_path(self._folder))
        if self._unread is None and seen == self._seen:
            return
        self._seen = seen
        try:
            self._state, self._unread = read_state(self._folder), None
        except UserError as error:
            if str(error) != self._unread:
                self._say(f"the state of the vehicle is not read, what was in force stays: {error}")
            self._unread = str(error)

    def _in_force(self, state: VehicleState) -> InForce:
        """Return the parameters that are in force by the state, or why there are none."""
        try:
            if state.in_force is None:
                raise _why_nothing(state)
            return InForce(parameters=self._usable(state, state.in_force))
        except UnfitError as error:
            return InForce(parameters=None, reason=error.reason, why_not=f"{self._folder}: {error}")

    def _usable(self, state: VehicleState, found: ParameterSet) -> VehicleParameters:
        """Return the parameters of a set, checked for expiry and fit; decoded only once, as the bus waits meanwhile."""
        require_not_expired(found, state, self._now())
        if self._fitting is None or self._fitting[0] is not found:
            parameters = found.parameters
            check_fit(parameters, self._database, self._vehicle or state.vehicle)
            self._fitting = found, parameters
        return self._fitting[1]

    def _try(self, corrector: Corrector, now_s: float) -> None:
        """Begin or continue the trial of the set on trial; at its end, have the set put in force or dropped."""
        on_trial = self._state.on_trial if self._state is not None else None
        if on_trial != self._tried:
            self._tried, self._trial, self._no_trial, self._result = on_trial, None, None, None
            self._retry_due_s = float("-inf")
        if self._state is None or on_trial is None:
            return
        if self._result is not None:
            passed, text = self._result
            self._write(partial(conclude, self._folder, on_trial, passed=passed, text=text, now=self._now()), now_s)
        elif self._trial is not None:
            if corrector.watch.is_whole(now_s):
                self._result = self._trial.look(now_s)
        elif now_s >= self._retry_due_s:
            try:
                parameters = self._usable(self._state, on_trial)
            except UnfitError as error:
                self._retry_due_s = now_s + _RETRY_EVERY_S
                if error.reason is not self._no_trial:
                    self._no_trial = error.reason
                    self._say(f"no trial yet: {error}")
                return
            self._say(f"{on_trial} is on trial")
            self._trial = ParameterTrial(parameters, self._database, corrector.branches)

    def _end_expired(self, state: VehicleState, now_s: float) -> None:
        """Remove the set in force for good once it has been seen expired for a minute."""
        found, now = state.in_force, self._now()
        if found is None or now < found.expires:
            self._expired_since = None
            return
        self._expired_since = self._expired_since or now
        if now - self._expired_since >= _SURELY_EXPIRED:
            self._write(partial(end_expired, self._folder, found, now), now_s)

    def _write(self, work: Callable[[], VehicleState], now_s: float) -> None:
        """Write a decision in the background, unless one is being written or an attempt failed a moment ago."""
        if self._writing is None and now_s >= self._retry_due_s:
            self._writing = self._background.submit(work)

    def _finish_writing(self, now_s: float) -> None:
        """Adopt a decision once it is written; if that failed, nothing changes, and it is tried again later."""
        if self._writing is None or not self._writing.done():
            return
        written, self._writing = self._writing, None
        try:
            self._state = written.result()
        except UserError as error:
            self._retry_due_s = now_s + _RETRY_EVERY_S
            self._say(
                f"a decision cannot be written now, what was in force stays, and it is tried again in "
                f"{_RETRY_EVERY_S:g} s: {error}"
            )
            return
        self._due_s = float("-inf")
        if self._result is not None and self._state.on_trial != self._tried:
            tried, result, self._result = self._tried, self._result, None
            if result.passed and self._state.in_force != tried:
                self._say(f"{tried} is not in force, though its trial went well: the end of decisions.log says why")
            else:
                self._say(f"{tried} has {'passed' if result.passed else 'failed'} its trial: {result.text}")


def _why_nothing(state: VehicleState) -> TrustError:
    """Return the error that says why no set is in force."""
    if state.on_trial is not None:
        return TrustError(Reason.ON_TRIAL, f"{state.on_trial} is on trial, and nothing is in force yet")
    if state.ended == "revoked":
        return TrustError(Reason.REVOKED, "what was in force is revoked; update to new parameters")
    if state.ended == "expired":
        return TrustError(Reason.NOT_VALID_NOW, "what was in force has expired; update to new parameters")
    return TrustError(Reason.NO_PARAMETERS, "nothing came yet; see 'ecu-node update'")
