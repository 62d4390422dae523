"""Signs of proposed branches: from a log by the junction sum and the battery's voltage, else by convention."""

from collections.abc import Sequence
from dataclasses import dataclass

from calibrator.doctor.bands import branch_bands
from calibrator.doctor.junction import orientation_of, peaks
from calibrator.doctor.multipliers import Known, explanations
from calibrator.doctor.words import words_of
from calibrator.drive import Drive
from calibrator.proposal.branches import ProposedBranch

__all__ = ["ProposedSign", "propose_signs", "usual_signs"]

SIGNS_ONLY = (1.0,)
"""Units are taken as the DBC has them."""
CLEAR = 2.0
"""The sum must vary by this much more with the other sign, to call it told. [1]"""
SAG = 0.5
"""Orientation above which the voltage has told it. [1]"""


@dataclass(frozen=True, kw_only=True)
class ProposedSign:
    """Sign of a branch, and why."""

    sign: int
    reason: str


def usual_signs(branches: Sequence[ProposedBranch]) -> dict[str, ProposedSign]:
    """Signs as comments of the DBC tell them, or by convention: discharge and consumption count as positive.

    Parameters
    ----------
    branches : sequence of ProposedBranch
        The branches.

    Returns
    -------
    dict of str to ProposedSign
        By branch.
    """
    return {branch.name: _usual(branch) for branch in branches}


def _usual(branch: ProposedBranch) -> ProposedSign:
    out, into = ("discharge", "charge") if branch.place == "battery" else ("recuperation", "consumption")
    words = set(words_of(branch.signal.signal.comment))
    if "positive" in words and (out in words) != (into in words):
        positive = out if out in words else into
        return ProposedSign(sign=1 if out in words else -1, reason=f"its comment says that {positive} is positive")
    sign, what = (1, "discharge") if branch.place == "battery" else (-1, "consumption")
    return ProposedSign(sign=sign, reason=f"if {what} is positive in the DBC; else {-sign}")


def propose_signs(
    drive: Drive, branches: Sequence[ProposedBranch], full_scale_a: float, voltage: str
) -> dict[str, ProposedSign]:
    """Find the signs with which the sum varies least.

    Parameters
    ----------
    drive : Drive
        Branches with the usual signs, and the voltage as an input.
    branches : sequence of ProposedBranch
        The branches.
    full_scale_a : float
        Of the junction. [A]
    voltage : str
        Input that is the battery's voltage.

    Returns
    -------
    dict of str to ProposedSign
        By branch.
    """
    places = {branch.name: branch.place for branch in branches}
    usual = usual_signs(branches)
    names = [name for name in places if name in drive.branches and drive.branches[name].good.any()]
    battery = next((name for name in names if places[name] == "battery"), None)
    if len(names) < 2 or battery is None:
        return usual
    bands = branch_bands([drive], names)
    if not len(bands.block):
        return usual
    orientation = orientation_of([drive], battery, voltage)
    known = Known(peak_share=peaks([drive], names) / full_scale_a, source=names.index(battery), orientation=orientation)
    best = explanations(bands, known, factors=SIGNS_ONLY)[0].multipliers
    told = dict(usual)
    for k, name in enumerate(names):
        other = best.copy()
        other[k] = -other[k]
        with_it, without = bands.rms_a(best), bands.rms_a(other)
        sign = usual[name].sign * int(best[k])
        if name == battery and abs(orientation) > SAG:
            reason = f"with it the voltage falls when the current rises, and the sum varies by {with_it:.2g} A"
        elif without > CLEAR * with_it:
            reason = f"with it the sum of all varies by {with_it:.2g} A, with the other by {without:.2g} A"
        else:
            reason = f"{usual[name].reason}; too little current in this log for the sum to tell"
        told[name] = ProposedSign(sign=sign, reason=reason)
    return told
