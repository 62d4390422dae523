"""Signed parameters of a running node: those in force, those on trial, and the way from one to the other."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from datetime import datetime
from functools import partial
from pathlib import Path

from ecu_node.bus.wiring import InForce, Mode, put_in_force
from ecu_node.core.corrector import Corrector
from ecu_node.core.status import Reason, TrustError, UnfitError
from ecu_node.database import VehicleDatabase
from ecu_node.documents import FileSignature, signature
from ecu_node.errors import UserError
from ecu_node.parameters import check_fit
from ecu_node.trust.activation import conclude
from ecu_node.trust.state import Slot, SlotName, TrustState, read_state, signed_parameters, slot_path, state_path
from ecu_node.trust.statements import SignedParameters
from ecu_node.trust.trial import ParameterTrial, TrialResult, begin_trial
from ecu_node.trust.validity import require_time

__all__ = ["ParameterStore"]

_LOOK_EVERY_S = 1.0
"""Between looks whether the state has changed, or what is in force has expired. [s]"""
_RETRY_EVERY_S = 60.0
"""Between attempts to begin a trial, as before the clock is set, or to keep its end, as on a full disk. [s]"""
_CHANGING_S = 3.0
"""So long a slot may be another one than the state knows, as while a command changes both. [s]"""
_OTHER_FILE = (Reason.NOT_SIGNED, Reason.NO_PARAMETERS)
"""Why a set on trial is not read if its slot holds another file than the state knows, or none."""


class ParameterStore:
    """Keeps the parameters of a running node as the state of its vehicle says.

    Parameters
    ----------
    folder : Path
        State of the vehicle.
    database : VehicleDatabase
        Layout and DBC in use.
    mode : Mode
        Where corrected values go.
    say : callable
        Takes one line for the log.
    now : callable
        The time of day.
    vehicle : str or None
        Identity of the vehicle, where it is known besides; the state of another one is not used.
    background : Executor or None
        Writes how a trial ended, as a slow disk may take seconds, and the bus must not wait; None: written at once.
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
        background: Executor | None = None,
    ) -> None:
        self._folder, self._database, self._mode, self._say, self._now = folder, database, mode, say, now
        self._vehicle = vehicle
        self._background = background
        self._due_s = self._retry_due_s = float("-inf")
        self._trial: ParameterTrial | None = None
        self._no_trial: Reason | None = None
        self._changing_until_s: float | None = None
        self._result: TrialResult | None = None
        self._end: Future[TrustState] | None = None
        self._tried: int | None = None
        self._unread: str | None = None
        self._read: tuple[Slot, FileSignature | None, SignedParameters] | None = None
        self._seen = signature(state_path(folder))
        self._state: TrustState | None = None
        self._revoked: set[int] = set()
        self._number: int | None = None
        """Of what is in force, as it was signed."""
        self.in_force: InForce
        self.why_not: str | None
        try:
            self._state = read_state(folder)
        except TrustError as error:
            self.in_force, self.why_not = InForce(parameters=None, reason=error.reason), str(error)
            self._unread = str(error)
        else:
            self.in_force, self.why_not = self._in_force(self._state)
            self._number = _number_in_force(self._state, self.in_force)
            self._revoked.update(self._state.revoked)

    def look(self, corrector: Corrector, now_s: float, *, asked: bool = False) -> bool:
        """See whether a trial has ended, the state was changed, or time has passed; to be called now and then.

        Parameters
        ----------
        corrector : Corrector
            Where new parameters are put in force.
        now_s : float
            Now. [s]
        asked : bool
            Read the state whether it was changed or not.

        Returns
        -------
        bool
            Whether other parameters are in force than before, or none.
        """
        self._try(corrector, now_s)
        if not asked and now_s < self._due_s:
            return False
        self._due_s = now_s + _LOOK_EVERY_S
        if self._end is None:
            self._read_again(asked=asked)
        return self._state is not None and self._put_in_force(corrector, self._state, now_s)

    def _read_again(self, *, asked: bool) -> None:
        """Read the state if it was changed, or could not be read the last time: it may hold a revocation."""
        seen = signature(state_path(self._folder))
        if not asked and self._unread is None and seen == self._seen:
            return
        self._seen = seen
        try:
            self._state, self._unread = read_state(self._folder), None
        except UserError as error:
            if asked or str(error) != self._unread:
                self._say(f"the state of the vehicle is not read, what was in force stays: {error}")
            self._unread = str(error)

    def _put_in_force(self, corrector: Corrector, state: TrustState, now_s: float) -> bool:
        in_force, why_not = self._in_force(state)
        if in_force.reason is Reason.NOT_SIGNED and signature(state_path(self._folder)) != self._seen:
            return False  # state and slot are changed just now; both are read again
        number = _number_in_force(state, in_force)
        self._say_revoked(state, number)
        is_other, is_other_number = in_force != self.in_force, number != self._number
        if is_other:
            put_in_force(corrector, self._database, in_force, now_s, mode=self._mode)
            corrector.counters.reloads += 1
        self.in_force, self.why_not, self._number = in_force, why_not, number
        found = in_force.parameters
        if found is not None and (is_other or is_other_number):
            self._say(f"number {number}: parameter set {found.number} of vehicle {found.vehicle} is in force")
        elif is_other:
            self._say(f"passing measured values through: {why_not}")
        return is_other

    def _say_revoked(self, state: TrustState, number: int | None) -> None:
        """Say which numbers were revoked since the last time, and what is in force now."""
        revoked = sorted(set(state.revoked) - self._revoked)
        if not revoked:
            return
        self._revoked.update(revoked)
        numbers = f"number {revoked[0]} was" if len(revoked) == 1 else f"numbers {', '.join(map(str, revoked))} were"
        self._say(f"{numbers} revoked; {'nothing' if number is None else f'number {number}'} is in force")

    def _in_force(self, state: TrustState) -> tuple[InForce, str | None]:
        """What the state says, and why there are no parameters."""
        if state.in_force is None:
            reason, text = _why_nothing(state)
            return InForce(parameters=None, reason=reason), f"{self._folder}: {text}"
        try:
            signed = self._signed(state, state.in_force)
            require_time(state, signed, str(self._folder), self._now())
        except UnfitError as error:
            return InForce(parameters=None, reason=error.reason), str(error)
        return InForce(parameters=signed.parameters), None

    def _signed(self, state: TrustState, name: SlotName) -> SignedParameters:
        """What stands in a slot; read again only if its file was changed, as the bus waits meanwhile."""
        slot, seen = state.slots[name], signature(slot_path(self._folder, name))
        if self._read is None or self._read[:2] != (slot, seen):
            signed = signed_parameters(self._folder, state, name)
            check_fit(signed.parameters, self._database, self._vehicle or state.vehicle)
            self._read = slot, seen, signed
        return self._read[2]

    def _fitting(self, state: TrustState, name: SlotName) -> SignedParameters:
        """What stands in a slot, if it may be used here and now."""
        signed = signed_parameters(self._folder, state, name)
        require_time(state, signed, str(self._folder), self._now())
        check_fit(signed.parameters, self._database, self._vehicle or state.vehicle)
        return signed

    def _try(self, corrector: Corrector, now_s: float) -> None:
        """Go on with a trial; at its end what was tried is in force, or gone."""
        number = self._number_on_trial()
        if number != self._tried:
            self._tried, self._trial, self._no_trial, self._result = number, None, None, None
            self._changing_until_s = None
            self._retry_due_s = float("-inf")
        if number is None:
            return
        if self._result is not None:
            self._conclude(number, self._result, now_s)
        elif self._trial is None:
            self._begin(corrector, now_s)
        elif corrector.watch.is_whole(now_s):
            self._result = self._trial.look(now_s)

    def _conclude(self, number: int, result: TrialResult, now_s: float) -> None:
        """Keep how a trial ended; try again later if that cannot be written, as what was in force stays meanwhile."""
        if self._end is None:
            if now_s < self._retry_due_s:
                return
            self._end = self._start(
                partial(conclude, self._folder, number, passed=result.passed, text=result.text, now=self._now())
            )
        if not self._end.done():
            return
        end, self._end = self._end, None
        try:
            self._state = end.result()
        except UserError as error:
            self._retry_due_s = now_s + _RETRY_EVERY_S
            self._say(
                f"how the trial of number {number} ended cannot be kept now, what was in force stays, and it is tried "
                f"again in {_RETRY_EVERY_S:g} s: {error}"
            )
            return
        self._result, self._due_s = None, float("-inf")
        in_force = self._state.slots[self._state.in_force].sequence if self._state.in_force else None
        if result.passed and in_force != number:
            self._say(f"number {number} is not in force, though its trial went well: the end of the audit log says why")
        else:
            self._say(f"number {number} {'has passed' if result.passed else 'has failed'} its trial: {result.text}")

    def _start(self, work: Callable[[], TrustState]) -> "Future[TrustState]":
        if self._background is not None:
            return self._background.submit(work)
        done: Future[TrustState] = Future()
        try:
            done.set_result(work())
        except UserError as error:
            done.set_exception(error)
        return done

    def _number_on_trial(self) -> int | None:
        if self._state is None or self._state.on_trial is None:
            return None
        return self._state.slots[self._state.on_trial].sequence

    def _begin(self, corrector: Corrector, now_s: float) -> None:
        """Begin the trial if the set may be used here and now; else try again later, as when the clock is set."""
        assert self._state is not None
        assert self._state.on_trial is not None
        if now_s < self._retry_due_s:
            return
        try:
            signed = self._fitting(self._state, self._state.on_trial)
        except UnfitError as error:
            if error.reason in _OTHER_FILE and self._may_be_changing(now_s):
                return
            self._retry_due_s = now_s + _RETRY_EVERY_S
            if error.reason is not self._no_trial:
                self._no_trial = error.reason
                self._say(f"no trial yet: {error}")
            return
        self._retry_due_s, self._changing_until_s = float("-inf"), None
        self._say(f"number {signed.sequence} is on trial: parameter set {signed.parameters.number}")
        self._trial = begin_trial(signed.parameters, self._database, corrector.branches)

    def _may_be_changing(self, now_s: float) -> bool:
        """Whether state and slot may be changed by a command just now; then both are read again soon."""
        if self._changing_until_s is None:
            self._changing_until_s = now_s + _CHANGING_S
        if now_s >= self._changing_until_s:
            return False
        self._seen, self._due_s = None, float("-inf")
        self._retry_due_s = now_s + _LOOK_EVERY_S
        return True


def _number_in_force(state: TrustState, in_force: InForce) -> int | None:
    if in_force.parameters is None or state.in_force is None:
        return None
    return state.slots[state.in_force].sequence


def _why_nothing(state: TrustState) -> tuple[Reason, str]:
    if state.on_trial is not None:
        return (
            Reason.ON_TRIAL,
            f"number {state.slots[state.on_trial].sequence} is on trial, and nothing is in force yet",
        )
    if state.revoked:
        return (
            Reason.REVOKED,
            f"number {state.revoked[-1]} was revoked, and nothing else is in force; activate new ones",
        )
    return Reason.NO_PARAMETERS, "nothing was activated yet; see 'ecu-node activate'"
