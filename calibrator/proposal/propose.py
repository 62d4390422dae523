"""A layout as it can be guessed from a DBC, and better from a log beside it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from calibrator.doctor.junction import peaks
from calibrator.drive import Drive
from calibrator.errors import LogError, ProposalError
from calibrator.proposal.branches import ProposedBranch, propose_branches
from calibrator.proposal.inputs import ProposedDerived, ProposedInput, propose_derived, propose_inputs
from calibrator.proposal.signals import QUANTITIES, Candidate, candidates, with_log
from calibrator.proposal.signs import ProposedSign, propose_signs, usual_signs
from calibrator.proposal.targets import ProposedTarget, propose_targets
from calibrator.recordings.frames import read_frames
from calibrator.recordings.readers import drive_from_frames
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import DatabaseError
from ecu_node.layout import Branch, Input, Layout
from ecu_node.units import AMPERE

__all__ = ["Proposal", "propose_layout"]

VOLTAGE = "voltage"
TYPICAL_A = 400.0
"""Full scale of many cars' junctions, where neither DBC nor log tells it. [A]"""
LARGEST_A = 2000.0
"""A range beyond it is that of the number of bits, not of a current. [A]"""
HEADROOM = 2.0
"""A recorded drive hardly ever has the nominal maximum in it. [1]"""
ROUND = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
TIMEOUT_PERIODS, GAP_TIMES = 5.0, 1.5
"""A time-out bridges four lost frames, and the gaps that a log shows. [1]"""
LEAST_TIMEOUT_S, USUAL_TIMEOUT_S, LONGEST_TIMEOUT_S = 0.1, 0.5, 2.0
"""A time base of 0.1 s needs no less; where no rate is known; longer gaps are losses. [s]"""
TIMEOUT_STEP_S = 0.05


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """A layout as it is guessed.

    Attributes
    ----------
    name : str
        Of the layout.
    dbc : Path
        The DBC.
    log : Path or None
        What was looked at beside it.
    full_scale_a : float
        Of the junction. [A]
    full_scale_reason : str
        Where that comes from.
    branches : tuple of ProposedBranch
        At least two.
    signs : dict of str to ProposedSign
        By branch.
    timeouts_s : dict of str to float
        By branch. [s]
    inputs : tuple of ProposedInput
        What drives the currents.
    derived : tuple of ProposedDerived
        What is made of them.
    targets : dict of str to ProposedTarget
        Where corrected values go, by branch.
    """

    name: str
    dbc: Path
    log: Path | None
    full_scale_a: float
    full_scale_reason: str
    branches: tuple[ProposedBranch, ...]
    signs: dict[str, ProposedSign]
    timeouts_s: dict[str, float]
    inputs: tuple[ProposedInput, ...]
    derived: tuple[ProposedDerived, ...]
    targets: dict[str, ProposedTarget]

    @property
    def voltage(self) -> Candidate | None:
        """The voltage that powers are divided by."""
        return next((item.signal for item in self.inputs if item.role == VOLTAGE), None)


def propose_layout(dbc: Path, log: Path | None, name: str) -> Proposal:
    """Guess the layout of a vehicle.

    Parameters
    ----------
    dbc : Path
        Its DBC.
    log : Path or None
        One of its logs: only signals in it are then proposed, and signs are told by the junction sum.
    name : str
        Of the layout.

    Returns
    -------
    Proposal
        To be confirmed by somebody who knows the vehicle.

    Raises
    ------
    DatabaseError, LogError
        If one of the files cannot be used.
    ProposalError
        If no two branches can be found.
    """
    if not dbc.is_file():
        raise DatabaseError(f"{dbc}: no such DBC")
    database = read_database(_layout(name, dbc, 1.0, [], []))
    everything = found = candidates(database)
    frames = None
    if log is not None:
        frames = read_frames(log)
        found = with_log(found, frames)
        if not found:
            raise LogError(f"{log}: none of its identifiers is in {dbc}; check that both belong to the same vehicle")
    branches = propose_branches(found)
    battery = next((branch.signal for branch in branches if branch.place == "battery"), None)
    inputs = propose_inputs(found, battery=battery, taken={branch.signal.name for branch in branches})
    voltage = next((item.signal for item in inputs if item.role == VOLTAGE), None)
    usable = [branch for branch in branches if branch.signal.quantity == "current" or voltage is not None]
    _require_two(usable, branches, dbc, log)
    signs = usual_signs(usable)
    full_scale_a, reason = _scale_of_range(battery)
    if frames is not None and log is not None:
        layout = _layout(name, dbc, full_scale_a, [_branch(b, signs[b.name].sign, voltage) for b in usable], inputs)
        seen = VehicleDatabase(layout=layout, database=database.database, digest=database.digest)
        drive = drive_from_frames(frames, seen, vehicle=name, name=log.name, where=str(log)).drive
        full_scale_a, reason = _scale_of_log(drive)
        signs = propose_signs(drive, usable, full_scale_a, VOLTAGE)
    return Proposal(
        name=name,
        dbc=dbc,
        log=log,
        full_scale_a=full_scale_a,
        full_scale_reason=reason,
        branches=tuple(usable),
        signs=signs,
        timeouts_s={branch.name: _timeout_s(branch.signal) for branch in usable},
        inputs=tuple(inputs),
        derived=tuple(propose_derived(inputs)),
        targets=propose_targets(everything, usable),
    )


def _layout(
    name: str, dbc: Path, full_scale_a: float, branches: list[Branch], inputs: Sequence[ProposedInput]
) -> Layout:
    return Layout(
        schema=1,
        name=name,
        dbc=str(dbc.absolute()),
        full_scale_a=full_scale_a,
        branch=branches,
        input=[Input(name=item.name, signal=item.signal.name) for item in inputs],
        path=Path(f"{name}.toml"),
        digest="",
    )


def _branch(branch: ProposedBranch, sign: int, voltage: Candidate | None) -> Branch:
    one: Literal[1, -1] = 1 if sign > 0 else -1
    if branch.signal.quantity == "current" or voltage is None:
        return Branch(name=branch.name, sign=one, signal=branch.signal.name)
    return Branch(name=branch.name, sign=one, power=branch.signal.name, voltage=voltage.name)


def _require_two(
    usable: Sequence[ProposedBranch], branches: Sequence[ProposedBranch], dbc: Path, log: Path | None
) -> None:
    if len(usable) > 1:
        return
    units = "; ".join(", ".join(sorted(QUANTITIES[name])) for name in ("current", "power"))
    if len(branches) > 1:
        raise ProposalError(
            f"{dbc}: powers are there ({', '.join(branch.signal.name for branch in branches)}), but no voltage of the "
            f"junction to divide them by; looked for units {', '.join(sorted(QUANTITIES['voltage']))}"
        )
    where = f"{dbc}, among the messages of {log}" if log is not None else str(dbc)
    known = ", ".join(branch.signal.name for branch in branches) or "none"
    raise ProposalError(
        f"{where}: no two signals look like branches of the junction (found: {known}); looked for units {units}, with "
        f"words such as battery, pack, motor, inverter, heater, compressor, dcdc in names and comments; write the "
        f"layout by hand (docs/layout.md)"
    )


def _scale_of_range(battery: Candidate | None) -> tuple[float, str]:
    if battery is not None and battery.quantity == "current":
        reach_a = battery.reach * AMPERE[battery.signal.unit or ""]
        if reach_a <= LARGEST_A:
            return reach_a, f"the DBC lets {battery.signal.name} reach {reach_a:g} A"
    return TYPICAL_A, "typical of a car; the DBC does not tell it"


def _scale_of_log(drive: Drive) -> tuple[float, str]:
    peak_a = float(np.max(peaks([drive], list(drive.branches))))
    if not peak_a > 0.0:
        return TYPICAL_A, "typical of a car; no current flows in the log"
    return _rounded_up(HEADROOM * peak_a), f"the log reaches {peak_a:.0f} A; give the nominal maximum"


def _rounded_up(value: float) -> float:
    decade = 10.0 ** math.floor(math.log10(value))
    return float(next(step * decade for step in ROUND if step * decade >= value * (1.0 - 1e-9)))


def _timeout_s(candidate: Candidate) -> float:
    """From the cycle time, or from what a log shows."""
    period_s = (candidate.message.cycle_time or 0) * 1e-3
    wanted_s = TIMEOUT_PERIODS * period_s if period_s else USUAL_TIMEOUT_S
    seen = candidate.seen
    if seen is not None and math.isfinite(seen.period_s):
        wanted_s = max(TIMEOUT_PERIODS * seen.period_s, GAP_TIMES * seen.gap_s)
    wanted_s = min(wanted_s, LONGEST_TIMEOUT_S)
    return max(round(math.ceil(wanted_s / TIMEOUT_STEP_S - 1e-9) * TIMEOUT_STEP_S, 3), LEAST_TIMEOUT_S)
