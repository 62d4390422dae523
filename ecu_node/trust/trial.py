"""Trial of a parameter set on its own vehicle: the Kirchhoff sum must fall as the calibrator says, before it is used.

The set changes the sum from m (measured) to c, by m - c = s. If the set is right, what remains in c has nothing to do
with s, and the mean square of the sum falls by just that of s:

    share = (E[m^2] - E[c^2]) / E[s^2],    1 if the set is right, 0 if half of s is wrong, -1 if all of it is.

The share does not depend on how hard the vehicle is driven. The parameter file tells which share the calibrator saw on
the drives that it used; where it is below 1, as where a load that no sensor sees is taken for an offset, so is this.
A set whose s stays below the layout's margin changes nothing that this sum could tell, and must make it no worse.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ecu_node.branch import LiveBranch
from ecu_node.correction import SensorFault
from ecu_node.junction_watch import aligned_currents
from ecu_node.parameters import JunctionResidual

__all__ = ["Trial", "TrialResult", "TrialRules"]


@dataclass(frozen=True, kw_only=True)
class TrialRules:
    """When a trial ends, and what it takes.

    Attributes
    ----------
    duration_s : float
        So long currents must have flown. [s]
    tolerance : float
        By so much the share may be below what the calibrator saw. [1]
    margin_a : float
        Sums that differ by less are the same. [A]
    least_current_a : float
        A branch carries this at least, or no current flows. [A]
    """

    duration_s: float
    tolerance: float
    margin_a: float
    least_current_a: float


@dataclass(frozen=True, kw_only=True)
class TrialResult:
    """How a trial ended."""

    passed: bool
    text: str


class Trial:
    """One set on trial.

    Parameters
    ----------
    branches : sequence of LiveBranch
        All branches of the layout.
    faults : mapping of str to SensorFault
        What the set corrects, by branch; a branch that is not named is not corrected.
    delays_s : mapping of str to float
        Delays of the set. [s]
    residual : JunctionResidual
        What the calibrator saw.
    rules : TrialRules
        When it ends.
    """

    def __init__(
        self,
        branches: Sequence[LiveBranch],
        faults: Mapping[str, SensorFault],
        delays_s: Mapping[str, float],
        residual: JunctionResidual,
        rules: TrialRules,
    ) -> None:
        self._branches, self._faults, self._delays_s, self._rules = branches, faults, delays_s, rules
        self._promised = _share(residual.measured_a**2, residual.corrected_a**2, (residual.correction_a or 0.0) ** 2)
        self._looks = 0
        self._measured2 = self._corrected2 = self._step2 = 0.0
        self._time_s = 0.0
        self._last_s = self._instant_s = float("-inf")

    def look(self, now_s: float) -> TrialResult | None:
        """Take the sums of now; the result once there is one.

        Parameters
        ----------
        now_s : float
            Now. [s]

        Returns
        -------
        TrialResult or None
            None while more is to be seen.
        """
        passed_s, self._last_s = now_s - self._last_s, now_s
        found = aligned_currents(self._branches, self._delays_s, now_s)
        if found is None or found[0] <= self._instant_s:
            return None
        self._instant_s, currents = found
        measured = {name: pair[0] for name, pair in currents.items()}
        if max(map(abs, measured.values())) < self._rules.least_current_a:
            return None
        corrected = [self._corrected(name, current) for name, current in measured.items()]
        if any(current is None for current in corrected):
            return None
        self._add(sum(measured.values()), sum(current for current in corrected if current is not None))
        self._time_s += min(passed_s, _LONGEST_STEP_S)
        return self._result() if self._time_s >= self._rules.duration_s else None

    def _corrected(self, name: str, current: float) -> float | None:
        fault = self._faults.get(name)
        if fault is None:
            return current
        sensor = next(branch.temperature for branch in self._branches if branch.name == name)
        return fault.true_current(current, sensor.value() if sensor is not None else None)

    def _add(self, measured_a: float, corrected_a: float) -> None:
        self._looks += 1
        self._measured2 += measured_a**2
        self._corrected2 += corrected_a**2
        self._step2 += (measured_a - corrected_a) ** 2

    def _result(self) -> TrialResult:
        measured, corrected, step = (
            (total / self._looks) ** 0.5 for total in (self._measured2, self._corrected2, self._step2)
        )
        seen = f"Kirchhoff sum {measured:.3g} A measured, {corrected:.3g} A corrected (RMS)"
        if step <= self._rules.margin_a:
            return TrialResult(
                passed=corrected <= measured + self._rules.margin_a, text=f"{seen}: no change that counts"
            )
        share, least = _share(measured**2, corrected**2, step**2), self._promised - self._rules.tolerance
        return TrialResult(
            passed=share >= least,
            text=f"{seen}: {share:.2f} of what the set changes was an error, {self._promised:.2f} was promised, "
            f"{least:.2f} is enough",
        )


_LONGEST_STEP_S = 0.5
"""More time than this between two looks is none in which currents were watched. [s]"""


def _share(measured2: float, corrected2: float, step2: float) -> float:
    """Share of the change that was an error; that of a right set where the change is not known. [1]"""
    if step2 <= 0.0:
        return 1.0 if corrected2 <= measured2 else 0.0
    return min(1.0, (measured2 - corrected2) / step2)
