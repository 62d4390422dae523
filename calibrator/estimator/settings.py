"""The user's choices of how a fleet, or single junctions, are calibrated, and the identity of a run."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from calibrator.errors import ContradictionError, FleetError
from calibrator.terminal.options import TIME_LIMIT_S
from calibrator.terminal.text import counted, few, few_reasons
from ecu_node import __version__
from ecu_node.database import VehicleDatabase
from ecu_node.documents import text_digest
from ecu_node.layout import UnmeasuredLoad, file_digest
from ecu_node.parameters import FileReference, Provenance

__all__ = [
    "CONFIDENT",
    "FEWEST_VEHICLES",
    "HARM_LIMIT",
    "SUSPECTED",
    "CalibrationSettings",
    "Method",
    "RunIdentity",
    "require_learning",
    "time_of_run",
]

FEWEST_VEHICLES = 5
"""Least size of a fleet that is compared with itself: in a smaller one it is not clear which vehicle differs."""
HARM_LIMIT = 0.001
"""Default limit: a branch is corrected if the probability of making it worse is below this. [1]"""
CONFIDENT, SUSPECTED = 0.95, 0.5
"""Confidence from which on a vehicle counts as known, and probability from which on a fault is suspected. [1]"""


class Method(StrEnum):
    """How sensor faults are estimated."""

    POSTERIOR = "posterior"
    PUBLISHED = "published"


@dataclass(frozen=True, kw_only=True)
class CalibrationSettings:
    """The user's choices for one calibration.

    Attributes
    ----------
    method : Method
        How sensor faults are estimated.
    branches : tuple of str or None
        Branches to use; None: those that the fleet has.
    hold_out : frozenset of str
        Vehicles that are calibrated, but from which nothing is learnt for the others.
    trusted : frozenset of str
        Names as the user gave them: either vehicles whose sensors were found faultless on a bench, which carry the
        reference of the posterior method; or branches whose sensor is right, if each vehicle is calibrated by itself.
    readings : Path, str or None
        Table of bench readings (CSV), or its text.
    alone : bool
        Whether each vehicle is calibrated by itself in any case.
    load : UnmeasuredLoad or None
        Load that no branch measures; None: that of the layout, if it states one.
    charge_ah : mapping of str to (float, float)
        For single junctions: charge into the junction through a branch during the recordings, and its standard
        deviation. [Ah]
    meter : str or None
        For single junctions: branch that has another sensor in each folder of recordings of one car.
    harm_limit : float
        A branch is corrected if the posterior probability of making it worse is below this. [1]
    expected_faults : float or None
        Share of the vehicles that have a sensor fault, if it is known; None: learnt from the fleet. [1]
    time_limit_s : float
        Longest time to read one vehicle, with either method; a vehicle that takes longer is left out. [s]

    Raises
    ------
    ContradictionError
        If a vehicle is both held out and trusted.
    """

    method: Method = Method.POSTERIOR
    branches: tuple[str, ...] | None = None
    hold_out: frozenset[str] = field(default_factory=frozenset)
    trusted: frozenset[str] = field(default_factory=frozenset)
    readings: Path | str | None = None
    alone: bool = False
    load: UnmeasuredLoad | None = None
    charge_ah: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    meter: str | None = None
    harm_limit: float = HARM_LIMIT
    expected_faults: float | None = None
    time_limit_s: float = TIME_LIMIT_S

    def __post_init__(self) -> None:
        if both := self.hold_out & self.trusted:
            raise ContradictionError(
                f"vehicle {few(sorted(both))} is both held out and trusted: the reference would be learnt from it"
            )

    def record(self) -> dict[str, Any]:
        """Return the settings that the method in use takes into account, for the record of a run."""
        found: dict[str, Any] = {"branches": self.branches, "hold_out": sorted(self.hold_out)}
        if self.method is Method.PUBLISHED:
            return found
        return found | {
            "harm_limit": self.harm_limit,
            "trusted": sorted(self.trusted),
            "readings": None if self.readings is None else _named_digest(self.readings),
            "expected_faults": self.expected_faults,
            "load": None if self.load is None else [self.load.mean_a, self.load.sd_a],
            "charge_ah": dict(self.charge_ah),
            "meter": self.meter,
        }


@dataclass(frozen=True, kw_only=True)
class RunIdentity:
    """Identity of one run of the calibrator, as parameter files record it.

    Attributes
    ----------
    database : VehicleDatabase
        DBC and layout that the parameters belong to.
    settings : CalibrationSettings
        The user's choices, such as the method of estimation.
    fleet, created : str
        Name of the fleet; time of the run, ISO 8601.
    """

    database: VehicleDatabase
    settings: CalibrationSettings
    fleet: str
    created: str

    @property
    def tool(self) -> str:
        """Name and version of the program."""
        return f"calibrator {__version__}"

    @property
    def layout(self) -> FileReference:
        """The layout file."""
        return FileReference(name=self.database.layout.name, sha256=self.database.layout.digest)

    @property
    def dbc(self) -> FileReference:
        """The DBC file."""
        return FileReference(name=self.database.layout.dbc_path.name, sha256=self.database.digest)

    def provenance(self, *, fleet_size: int, drives: Sequence[str], duration_s: float) -> Provenance:
        """Describe where the parameters of one vehicle come from."""
        return Provenance(
            tool=self.tool,
            method=self.settings.method.value,
            created=self.created,
            fleet=self.fleet,
            fleet_size=fleet_size,
            drives=list(drives),
            duration_s=round(duration_s, 3),
        )


def require_learning(names: Sequence[str], settings: CalibrationSettings, left_out: Mapping[str, str]) -> None:
    """Raise FleetError if too few usable vehicles may be learnt from; ``left_out``: why others are not usable."""
    learners = len(set(names) - settings.hold_out)
    if learners < 2:
        raise FleetError(
            f"{counted(learners, 'usable vehicle')} to learn from; a fleet that is compared with itself needs "
            f"{FEWEST_VEHICLES} or more, the drives of a single vehicle a sensor that is right (--trusted BRANCH)"
            f"{few_reasons(left_out)}"
        )


def time_of_run() -> str:
    """Return the time now in ISO 8601, or that of SOURCE_DATE_EPOCH if set, so that results are the same to the bit.

    Raises
    ------
    FleetError
        If SOURCE_DATE_EPOCH is no number of seconds.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        now = datetime.fromtimestamp(int(epoch), UTC) if epoch else datetime.now(UTC)
    except (ValueError, OverflowError, OSError):
        raise FleetError(f"SOURCE_DATE_EPOCH is {epoch!r}; expected seconds since 1970, or leave it unset") from None
    return now.isoformat(timespec="seconds")


def _named_digest(table: Path | str) -> list[str]:
    if isinstance(table, str):
        return ["data frame", text_digest(table.encode())]
    return [table.name, file_digest(table)]
