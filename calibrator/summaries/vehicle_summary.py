"""From the drives of one vehicle to its summary: delays between branches, zero-current windows, second moments."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrator.drive import Array, Channel, Drive, DriveFile
from calibrator.drives.align import Samples, align
from calibrator.drives.delays import BranchDelays, estimate_delays, without_delays
from calibrator.errors import DriveError
from calibrator.sources.fleet_source import Equipment, load_drive
from calibrator.summaries.filter_bank import FilterBank
from calibrator.summaries.moments import DriveSummary
from calibrator.summaries.summariser import summarise_samples
from calibrator.summaries.zero_current import ZeroCurrent, zero_current_offsets
from calibrator.terminal.text import counted
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout

__all__ = [
    "VehicleSummary",
    "most_moving_first",
    "read_samples",
    "read_vehicle_summary",
    "require_possible",
    "summarise_drives",
]

LEAST_DURATION_S = 120.0
"""Valid data below which a vehicle is left out: fewer than four blocks do not tell how sure anything is. [s]"""

MOST_OVER_FULL_SCALE = 10.0
"""Largest current that is taken for one, over full scale. [1]"""


@dataclass(frozen=True, kw_only=True)
class VehicleSummary:
    """One vehicle as the posterior sees it.

    Attributes
    ----------
    vehicle : str
        Name.
    drives : tuple of str
        Names of the drives used.
    summary : DriveSummary
        Of all of them, delays taken out.
    delays : BranchDelays
        Of its branches; the reference is the branch that moves most.
    zero_current : ZeroCurrent
        What the sensors showed while the contactors were open.
    recorded : frozenset of str
        Recorded inputs of which every drive has good samples.
    """

    vehicle: str
    drives: tuple[str, ...]
    summary: DriveSummary
    delays: BranchDelays
    zero_current: ZeroCurrent
    recorded: frozenset[str]


def read_samples(entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase) -> list[Samples]:
    """Read the drives of one vehicle as aligned samples, delays taken out.

    Parameters
    ----------
    entries, equipment, database
        As for :func:`read_vehicle_summary`.

    Returns
    -------
    list of Samples
        One per drive, with the inputs of the fleet model.

    Raises
    ------
    UserError
        If a drive cannot be read, or there is too little valid data; the message says which and how much.
    """
    return _aligned([load_drive(entry, database) for entry in entries], equipment, database).samples


def read_vehicle_summary(
    entries: Sequence[DriveFile], equipment: Equipment, database: VehicleDatabase, *, bank: FilterBank | None = None
) -> VehicleSummary:
    """Read the drives of one vehicle and summarise them.

    Parameters
    ----------
    entries : sequence of DriveFile
        Drives of one vehicle.
    equipment : Equipment
        Branches and model inputs of the fleet.
    database : VehicleDatabase
        DBC and layout.
    bank : FilterBank or None
        Filters of the fleet model's inputs; None: the plain inputs.

    Returns
    -------
    VehicleSummary
        The vehicle.

    Raises
    ------
    UserError
        If a drive cannot be read, or there is too little valid data; the message says which and how much.
    """
    found = summarise_drives([load_drive(entry, database) for entry in entries], equipment, database, bank=bank)
    return replace(found, vehicle=entries[0].vehicle, drives=tuple(entry.name for entry in entries))


def summarise_drives(
    drives: Sequence[Drive], equipment: Equipment, database: VehicleDatabase, *, bank: FilterBank | None = None
) -> VehicleSummary:
    """Summarise drives of one vehicle that were read already; as :func:`read_vehicle_summary`."""
    vehicle = _aligned(drives, equipment, database)
    return VehicleSummary(
        vehicle=drives[0].vehicle,
        drives=tuple(drive.name for drive in drives),
        summary=summarise_samples(
            vehicle.samples, period_s=database.layout.period_s, bank=bank, temperatures_c=vehicle.temperatures_c
        ),
        delays=vehicle.delays,
        zero_current=zero_current_offsets(drives, equipment.branches, database),
        recorded=frozenset.intersection(*(_recorded(drive) for drive in drives)),
    )


@dataclass(frozen=True, kw_only=True)
class _AlignedDrives:
    """Delays of the branches of one vehicle, its drives on one time base without them, temperatures if recorded."""

    delays: BranchDelays
    samples: list[Samples]
    temperatures_c: list[Array] | None


def _aligned(drives: Sequence[Drive], equipment: Equipment, database: VehicleDatabase) -> _AlignedDrives:
    layout = database.layout
    for drive in drives:
        require_possible(drive, layout)
    delays = estimate_delays(drives, most_moving_first(drives, equipment.branches))
    samples = [
        align(without_delays(drive, delays.by_branch()), layout, equipment.branches, inputs=equipment.fleet_inputs)
        for drive in drives
    ]
    duration_s = layout.period_s * sum(int(part.valid.sum()) for part in samples)
    if duration_s < LEAST_DURATION_S:
        raise DriveError(
            f"{duration_s:.1f} s of usable data in {counted(len(drives), 'drive')}; at least "
            f"{LEAST_DURATION_S:.0f} s are needed"
        )
    temperatures_c = None
    if layout.temperature is not None:
        pairs = zip(drives, samples, strict=True)
        temperatures_c = [_temperature_c(drive.inputs.get(layout.temperature), part) for drive, part in pairs]
    return _AlignedDrives(delays=delays, samples=samples, temperatures_c=temperatures_c)


def _temperature_c(channel: Channel | None, samples: Samples) -> Array:
    """Temperature at the instants of samples, NaN if it was not recorded; it changes slowly, so gaps do not matter."""
    if channel is None or not channel.good.any():
        return np.full(len(samples.time_s), np.nan)
    return np.interp(samples.time_s, channel.time_s[channel.good], channel.value[channel.good])


def require_possible(drive: Drive, layout: Layout) -> None:
    """Refuse currents that no sensor of this junction shows, and numbers that are none."""
    for name, channel in drive.branches.items():
        largest = float(np.abs(channel.value[channel.good]).max(initial=0.0))
        if not largest <= MOST_OVER_FULL_SCALE * layout.full_scale_a:
            raise DriveError(
                f"drive {drive.name}: branch {name} shows {largest:.3g} A, full scale of the junction being "
                f"{layout.full_scale_a:g} A; check its signal in the DBC, or full_scale_a in {layout.path.name}"
            )
    for name, channel in drive.inputs.items():
        if not np.isfinite(channel.value[channel.good]).all():
            raise DriveError(f"drive {drive.name}: input {name} has values that are no numbers; import it again")


def _recorded(drive: Drive) -> frozenset[str]:
    return frozenset(name for name, channel in drive.inputs.items() if channel.good.any())


def most_moving_first(drives: Sequence[Drive], branches: Sequence[str]) -> tuple[str, ...]:
    """Branches by falling variance; the order asked for where a drive lacks one, as is noticed later."""

    def variance_a2(name: str) -> float:
        channels = [drive.branches[name] for drive in drives if name in drive.branches]
        values: list[Array] = [channel.value[channel.good] for channel in channels]
        return float(np.var(np.concatenate(values))) if sum(map(len, values)) else 0.0

    return tuple(sorted(branches, key=variance_a2, reverse=True))
