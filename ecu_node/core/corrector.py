"""The node without its bus: frames and times go in, corrected frames and the status come out.

Overlay: a branch's frame is answered by its corrected message under an identifier of its own; nothing else is touched.
Gateway: a branch's frame goes on to the other bus with its current rewritten in place; only its own bits change, and
its counter stays, so that a receiver sees every frame that was lost or repeated. A frame that fails its check is never
given a valid CRC. Times are those of one steady clock. [s]
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ecu_node.core.branch import LiveBranch
from ecu_node.core.e2e import Protection
from ecu_node.core.frames import Source
from ecu_node.core.junction import ExpectedSum, JunctionWatch
from ecu_node.core.signals import BitPlace, Codes, FrameKey, as_written
from ecu_node.core.status import Counters, Reason, State

__all__ = ["OF_ONE_DRIVE", "Corrector", "StatusFields"]

OF_ONE_DRIVE = frozenset((Reason.BRANCH_STALE, Reason.BRANCH_STUCK))
"""What is tried anew after the bus has slept."""
_FOREIGN_S = 10.0
"""For so long after the last frame the status says that another node sends what only a gateway may. [s]"""
_IN_4_BITS = {
    Reason.SUM_IMPLAUSIBLE: Reason.CORRECTION_WORSE,
    Reason.FOREIGN_FRAMES: Reason.NONE,
    Reason.E2E_INVALID: Reason.INPUT_MISSING,
}


@dataclass(frozen=True, kw_only=True)
class StatusFields:
    """The status message, with the fields that the layout has."""

    key: FrameKey
    length: int
    fd: bool
    protection: Protection | None
    places: Mapping[str, BitPlace]
    """By their keys in the layout."""
    sums: Mapping[str, tuple[Codes, int]]
    """Signals of ``sum_measured`` and ``sum_corrected``, each with its code for "no value"."""


class Corrector:
    """The pure core of the node; built by :func:`ecu_node.bus.wiring.wire`.

    Parameters
    ----------
    sources : mapping of FrameKey to Source
        What is received; no other frame is looked at.
    branches : sequence of LiveBranch
        All branches of the layout.
    status_fields : StatusFields or None
        Status message, if the layout has one.
    watch : JunctionWatch
        Of these branches.
    counters : Counters
        The same that the sources count in.
    shadow : bool
        Compute and report, change nothing.
    sleep_s : float
        The bus sleeps once all branches have been silent for so long. [s]
    """

    def __init__(
        self,
        *,
        sources: Mapping[FrameKey, Source],
        branches: Sequence[LiveBranch],
        status_fields: StatusFields | None,
        watch: JunctionWatch,
        counters: Counters,
        shadow: bool,
        sleep_s: float,
    ) -> None:
        self.branches, self.shadow, self.watch, self._sleep_s = branches, shadow, watch, sleep_s
        self.counters = counters
        self.reason = Reason.NO_PARAMETERS
        """Why measured values are passed through, of the parameters; NONE where they fit."""
        self.latched = Reason.NONE
        """Why the node has fallen back to passing through, until parameters are put in force or :meth:`release`; what a
        branch did, or did not, also until the bus has slept."""
        self.latched_branches: tuple[str, ...] = ()
        self.told = (State.STARTING, Reason.NONE)
        """State and reason as of the last look; for other threads."""
        self.parameter_set = 0
        self.sources: dict[tuple[int, bool], Source] = dict(sources.items())
        """Who takes which frames, by identifier and whether it has 29 bits; no other frame is looked at."""
        self._looked_s = float("-inf")
        self._status_fields = status_fields
        self._silent, self._silent_since_s = True, float("inf")
        self._was_awake = False
        self._foreign, self._foreign_until_s = counters.foreign, float("-inf")
        self._beside = Reason.NONE
        """What is told beside a state that has no reason."""
        self._alive = 0
        self._payload = bytearray(status_fields.length if status_fields is not None else 0)
        if status_fields is not None and status_fields.protection is not None:
            status_fields.protection.before_first(self._payload)

    def put_in_force(self, *, reason: Reason, parameter_set: int, expected: ExpectedSum | None = None) -> None:
        """Begin with what the branches were just given; what was latched is released.

        Parameters
        ----------
        reason : Reason
            NONE if there are parameters that fit.
        parameter_set : int
            Its number as it is published; 0 where there is none.
        expected : ExpectedSum, optional
            What they say of the junction's sum.
        """
        self.reason, self.parameter_set = reason, parameter_set
        self.watch.restart(expected or ExpectedSum())
        self.latch(Reason.NONE)
        self.told = self.state()

    def look(self, now_s: float) -> None:
        """Look at the whole junction; to be called at least every 0.1 s."""
        if self.counters.foreign != self._foreign:
            self._foreign, self._foreign_until_s = self.counters.foreign, now_s + _FOREIGN_S
        self._beside = Reason.FOREIGN_FRAMES if now_s < self._foreign_until_s else Reason.NONE
        self._look(now_s)
        self.told = self.state()

    def _look(self, now_s: float) -> None:
        self._looked_s = now_s
        self._see_whether_asleep(now_s)
        self.watch.look(now_s)
        if self.reason is not Reason.NONE or self.latched is not Reason.NONE or self._silent:
            return
        if stale := [branch.name for branch in self.branches if self._is_missed(branch, now_s)]:
            self.latch(Reason.BRANCH_STALE, stale)
        elif verdict := self.watch.verdict():
            self.latch(*verdict)

    @property
    def is_asleep(self) -> bool:
        """Whether all branches are silent that were heard before."""
        return self._silent and self._was_awake

    def state(self) -> tuple[State, Reason]:
        """What the node does, and why."""
        reason = self.reason if self.reason is not Reason.NONE else self.latched
        if reason is not Reason.NONE:
            return State.PASSING_THROUGH, reason
        if self.is_asleep:
            return State.ASLEEP, Reason.NONE
        applied = [branch for branch in self.branches if branch.fault.applied]
        if self.shadow or not applied:
            return State.SHADOW if applied else State.PASSING_THROUGH, self._beside
        if any(branch.is_fitted and not branch.seen for branch in self.branches):
            return State.STARTING, Reason.NONE
        is_invalid = any(source.is_invalid for source in self.sources.values())
        if is_invalid or any(branch.lacks_input(self._looked_s) for branch in applied):
            return State.PARTLY_CORRECTING, Reason.E2E_INVALID if is_invalid else Reason.INPUT_MISSING
        return State.CORRECTING, self._beside

    def status(self) -> tuple[StatusFields, bytes] | None:
        """Make the status message from the last look; None if the layout has none."""
        fields = self._status_fields
        if fields is None:
            return None
        payload = self._payload
        state, reason = self.state()
        if reason > fields.places["reason"].highest:
            reason = _IN_4_BITS[reason]
        values = {"state": state, "reason": reason, "parameter_set": self.parameter_set, "alive_counter": self._alive}
        for key, place in fields.places.items():
            place.put(payload, values[key] % (place.highest + 1))
        self._alive += 1
        sums = self.watch.sums
        for key, (codes, missing) in fields.sums.items():
            total_a = None if sums is None else sums.measured_a if key == "sum_measured" else sums.corrected_a
            codes.place.put(payload, missing if total_a is None else codes.nearest(as_written(total_a)))
        if fields.protection is not None:
            fields.protection.advance(payload)
        return fields, bytes(payload)

    def _see_whether_asleep(self, now_s: float) -> None:
        """All branches silent: the vehicle goes to sleep, which is no fault.

        Once it sleeps, a branch that was silent or stuck is tried anew; what the sums said of the set in force stays.
        """
        silent = all(branch.is_old(now_s) for branch in self.branches)
        if not silent:
            self._silent_since_s = float("inf")
        elif self._silent_since_s == float("inf"):
            self.watch.forget()
            self._silent_since_s = now_s
        if self.latched in OF_ONE_DRIVE and now_s - self._silent_since_s >= self._sleep_s:
            self.release()
        if self._silent and not silent:
            self._was_awake = True
            for branch in self.branches:
                if branch.is_old(now_s):
                    branch.expect(now_s)
        self._silent = silent

    def release(self) -> None:
        """Try again what was latched."""
        self.watch.forget()
        self.latch(Reason.NONE)

    def _is_missed(self, branch: LiveBranch, now_s: float) -> bool:
        """Whether a branch is stale while others are not: where all fall silent in turn, the vehicle goes to sleep."""
        return branch.is_stale(now_s) and any(other.time_s > branch.deadline_s for other in self.branches)

    def latch(self, reason: Reason, branches: Sequence[str] = ()) -> None:
        """Pass measured values through for this reason, which these branches explain; NONE: as the parameters say."""
        self.latched, self.latched_branches = reason, tuple(branches)
        active = self.reason is Reason.NONE and reason is Reason.NONE and not self.shadow
        for branch in self.branches:
            branch.activate(active=active, doubted=reason is Reason.SUM_IMPLAUSIBLE and branch.name in branches)
