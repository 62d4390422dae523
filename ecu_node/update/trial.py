"""Trial of a parameter set on its own vehicle: the Kirchhoff sum must fall as the calibrator says, before it is used.

The set changes the sum from m (measured) to c, by s = m - c. Right sensors show the sum e: 0, or a load that none of
them sees. If the set is right, the remainder c - e is uncorrelated with s, and correction lowers the mean square of the
sum about e by exactly that of s:

    share = (E[(m - e)^2] - E[(c - e)^2]) / E[s^2]     1: the set is right; 0: half of s is wrong; -1: all of s is wrong

The share does not depend on how hard the vehicle is driven. The parameter file says e, and which share the calibrator
saw on the drives that it used; where that is below 1, as where one of two offsets that cancel is corrected, so is the
share on the vehicle. A set whose s stays below the layout's margin changes too little for its share to be judged; it
passes if it leaves the sum no worse. In either case the rest, the RMS of c - e, must not much exceed what the
calibrator saw: a set that removes one error and leaves others is not for this vehicle, or not any more.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from ecu_node.core.junction import LiveBranch, aligned_currents
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters

__all__ = ["ParameterTrial", "TrialResult"]

_LEAST_CURRENT_SHARE = 0.02
"""Trial time counts only while a branch carries this share of full scale. [1]"""
_MOST_LEFT = 2.0
"""Corrected sum (RMS) that is allowed, as a multiple of what the calibrator saw. [1]"""
_LONGEST_STEP_S = 0.5
"""Of the time between two looks at most this counts as watched. [s]"""


class TrialResult(NamedTuple):
    """How a trial ended."""

    passed: bool
    text: str


class ParameterTrial:
    """Trial of one set, evaluated at each look at the junction.

    Parameters
    ----------
    parameters : VehicleParameters
        The set; it also says what the calibrator saw.
    database : VehicleDatabase
        Layout and DBC in use; the layout sets the length and tolerance of a trial.
    branches : sequence of LiveBranch
        All branches of the layout, as the node sees them.
    """

    def __init__(
        self, parameters: VehicleParameters, database: VehicleDatabase, branches: Sequence[LiveBranch]
    ) -> None:
        layout, residual = database.layout, parameters.junction_residual
        self._branches, self._activation, self._margin_a = branches, layout.activation, layout.watch_margin_a
        self._least_current_a = _LEAST_CURRENT_SHARE * layout.full_scale_a
        self._faults = {name: parameters.fault(name) for name in layout.branch_names}
        self._delays_s = {name: branch.delay_s or 0.0 for name, branch in parameters.branches.items()}
        self._expected_a = residual.expected_a
        measured_a, corrected_a = residual.about_expected()
        self._promised = _share(measured_a**2, corrected_a**2, (residual.correction_a or 0.0) ** 2)
        self._left_a, self._step_a = corrected_a, residual.correction_a
        self._looks = 0
        self._measured2 = self._corrected2 = self._step2 = 0.0
        self._time_s = 0.0
        self._last_s = self._instant_s = float("-inf")

    def look(self, now_s: float) -> TrialResult | None:
        """Take the newest sums, and return the result once there is one.

        Parameters
        ----------
        now_s : float
            Now. [s]

        Returns
        -------
        TrialResult or None
            How the trial ended; None while it goes on.
        """
        passed_s, self._last_s = now_s - self._last_s, now_s
        found = aligned_currents(self._branches, self._delays_s, now_s)
        if found is None or found[0] <= self._instant_s:
            return None
        self._instant_s, currents = found
        measured = {name: pair[0] for name, pair in currents.items()}
        if max(map(abs, measured.values())) < self._least_current_a:
            return None
        measured_a = sum(measured.values())
        corrected_a = sum(self._faults[name].true_current(current) for name, current in measured.items())
        self._looks += 1
        self._measured2 += (measured_a - self._expected_a) ** 2
        self._corrected2 += (corrected_a - self._expected_a) ** 2
        self._step2 += (measured_a - corrected_a) ** 2
        self._time_s += min(passed_s, _LONGEST_STEP_S)
        return self._result() if self._time_s >= self._activation.trial_s else None

    def _result(self) -> TrialResult:
        """Judge the sums of the whole trial."""
        measured, corrected, step = (
            (total / self._looks) ** 0.5 for total in (self._measured2, self._corrected2, self._step2)
        )
        about = f" about {self._expected_a:+.3g} A" if self._expected_a else ""
        seen = f"Kirchhoff sum {measured:.3g} A measured, {corrected:.3g} A corrected (RMS{about})"
        most = self._most_left(step)
        if corrected > most:
            return TrialResult(
                passed=False,
                text=f"{seen}: at most {most:.3g} A were to be left; this vehicle has changed since its drives were "
                f"recorded, or the set is not its own",
            )
        if step <= self._margin_a:
            return TrialResult(passed=corrected <= measured + self._margin_a, text=f"{seen}: no change that counts")
        share, least = _share(measured**2, corrected**2, step**2), self._promised - self._activation.tolerance
        return TrialResult(
            passed=share >= least,
            text=f"{seen}: {share:.2f} of what the set changes was an error, {self._promised:.2f} was promised, "
            f"{least:.2f} is enough",
        )

    def _most_left(self, step_a: float) -> float:
        """Return the allowed corrected sum (RMS); it grows with the change that the set makes here, `step_a`. [A]"""
        if self._step_a is None:
            return math.inf
        harder = step_a / self._step_a if self._step_a > self._margin_a else 1.0
        return _MOST_LEFT * self._left_a * max(harder, 1.0) + self._margin_a


def _share(measured2: float, corrected2: float, step2: float) -> float:
    """Return the share of the change that was an error; without a change it is 1, or 0 if the sum is worse. [1]"""
    if step2 <= 0.0:
        return 1.0 if corrected2 <= measured2 else 0.0
    return min(1.0, (measured2 - corrected2) / step2)
