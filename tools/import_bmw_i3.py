#!/usr/bin/env python3
"""Import recordings of one BMW i3 (CSV, 10 Hz) as drives; each trip becomes a vehicle.

Source: Steinstraeter, Buberger, Trifonov, "Battery and Heating Data in Real Driving Cycles", IEEE DataPort,
DOI 10.21227/6jr9-5235. The car measures the battery current and the powers of heater and air conditioning; there is no
inverter and no DC/DC current. Into the junction, with V the battery voltage and equation (19) of the paper:

    i_battery   = -(Battery Current)                          discharge is negative in the file
    i_auxiliary = -(heater power + air conditioning power) / V
    i_motor     = -(i_battery + i_auxiliary)                  the DC/DC converter's 1 to 2 A included

So the motor's current is not independent of the battery's sensor. For the air conditioning the file has no request, and
the heater's request is often set while the heater is off; both demand inputs are therefore the powers themselves.

Known faults of the recordings, found in the data and labelled:

* heater power reads exactly 5.52 kW for single seconds (a default of the signal), often at the end of a straight
  line of up to ten seconds that comes from interpolation over a gap;
* a value beyond the range of its signal in the DBC: no frame could have carried it;
* heater power that does not flow: with the inverter idle, battery power minus heater minus air conditioning is what the
  DC/DC converter takes; in sound trips its median is 330 W or more, in trips with a stuck heater signal below 100 W.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from calibrator.drive import Array, Channel, Drive, Mask
from calibrator.drives.store import has_drive, require_plain_name, write_drive
from calibrator.errors import DriveError, LogError
from calibrator.files.folders import require_possible_folder
from calibrator.recordings.decode import SignalRange, signal_range
from calibrator.recordings.tables import Table, read_table
from calibrator.terminal.command_line import command_app, run_tool
from calibrator.terminal.progress import shown
from calibrator.terminal.text import dumps, told_once
from ecu_node.core.signals import AMPERE, unit_factor
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.errors import LayoutError, UserError
from ecu_node.layout import read_layout
from ecu_node.program import say_error, write_output

COLUMNS = {
    "speed": "Velocity [km/h]",
    "accelerator": "Throttle [%]",
    "torque": "Motor Torque [Nm]",
    "acceleration": "Longitudinal Acceleration [m/s^2]",
    "voltage": "Battery Voltage [V]",
    "current": "Battery Current [A]",
    "heater": "Heating Power CAN [kW]",
    "aircon": "AirCon Power [kW]",
}
"""Columns that every file must have."""
BRANCHES = ("battery", "motor", "auxiliary")
INPUTS = ("voltage", "torque", "speed", "acceleration", "accelerator", "heater_demand", "aircon_demand")

SHORTEST_S = 10.0
"""A shorter piece holds no change of load to learn from. [s]"""
HEATER_DEFAULT_KW = 5.52
HEATER_RESOLUTION_KW = 0.005
"""Half a step of the heater signal, which the file gives to 0.01 kW."""
IDLE_TORQUE_NM = 1.0
"""Below this torque the inverter takes next to nothing."""
LEAST_DCDC_W = 200.0
"""The control units of a running car take more than this; sound trips have 330 W or more."""
IMPOSSIBLE_JUMP_KW = 3.0
"""No heater's power changes by this much from one sample to the next."""
NEAR_DEFAULT_KW = 0.6
"""A sample beside a jump, at most this far from the default, counts as the default: a line that falls from there to 0
within 1 s changes by less from sample to sample."""
_HEATER_CHANNELS = "auxiliary, motor and heater_demand"
_MADE_OF = {"auxiliary": ("voltage", "heater_demand", "aircon_demand"), "motor": ("battery", "auxiliary")}
"""Branches that are computed, in this order, and the channels that they are made of: good where all of these are."""
_JUDGED_SAMPLES = 100
"""Least number of samples with the inverter idle, 10 s, from which the heater signal is judged."""
_SUFFIXES = (".csv", ".csv.gz")


app = command_app()


@app.command()
def main(
    *,
    csv: Annotated[list[Path], typer.Argument(help="CSV files (.csv, .csv.gz), or folders of them.")],
    layout: Annotated[Path, typer.Option(help="Layout with the branches battery, motor and auxiliary.")],
    out: Annotated[Path, typer.Option(help="Drive store to write to; trips that it has stay as they are.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the account as JSON.")] = False,
) -> None:
    """Turn recordings of a BMW i3 into drives; each file becomes a vehicle named after it."""
    require_possible_folder(out)
    database = read_database(read_layout(layout))
    names = {*database.layout.branch_names, *(item.name for item in database.layout.input)}
    if missing := [name for name in (*BRANCHES, *INPUTS) if name not in names]:
        raise LayoutError(f"{layout}: no branch or input named {', '.join(missing)}; use dbc/hv_powertrain.toml")
    done, already_there, failed = dict[str, ImportedTrip](), list[str](), dict[str, str]()
    trips = _trips(csv)
    for name, paths in shown(trips.items(), "import", len(trips), "trips"):
        try:
            trip = _import_trip(name, paths, database, out)
        except UserError as error:
            failed[name] = str(error)
            continue
        if trip is None:
            already_there.append(name)
        else:
            done[name] = trip
    if as_json:
        drives = {name: {"duration_s": trip.drive.duration_s, "notices": trip.notices} for name, trip in done.items()}
        write_output(dumps({"drives": drives, "already_there": already_there, "failed": failed}))
    else:
        duration_h = sum(trip.drive.duration_s for trip in done.values()) / 3600.0
        write_output(
            "\n".join(
                [
                    *told_once((name, notice) for name, trip in done.items() for notice in trip.notices),
                    f"{len(done)} trips imported, {duration_h:.1f} h; {len(already_there)} already there; "
                    f"{len(failed)} left out",
                    "motor is minus the sum of battery and auxiliary: not independent of the battery's sensor",
                ]
            )
        )
    for text in failed.values():
        say_error(f"import_bmw_i3: {text}")
    raise typer.Exit(1 if failed else 0)


@dataclass(frozen=True, kw_only=True)
class ImportedTrip:
    """A trip as a drive, and what of the file could not be used.

    Attributes
    ----------
    drive : Drive
        The drive; samples that cannot be used are labelled.
    notices : tuple of str
        What could not be used and why, one text each.
    """

    drive: Drive
    notices: tuple[str, ...]


def _trips(arguments: Iterable[Path]) -> dict[str, list[Path]]:
    """Return the files by the name of their trip; more than one file of a trip is refused later."""
    trips: dict[str, list[Path]] = {}
    for argument in arguments:
        found = sorted(p for p in argument.iterdir() if p.name.endswith(_SUFFIXES)) if argument.is_dir() else [argument]
        if not found:
            raise LogError(f"{argument}: no CSV files in this folder; expected {' or '.join(_SUFFIXES)}")
        for path in found:
            paths = trips.setdefault(path.name.removesuffix(".gz").removesuffix(".csv"), [])
            if path.resolve() not in [other.resolve() for other in paths]:
                paths.append(path)
    return trips


def _import_trip(name: str, paths: list[Path], database: VehicleDatabase, out: Path) -> ImportedTrip | None:
    """Import a trip into the store `out` and return it; None if it is there already."""
    if len(paths) > 1:
        raise LogError(f"two files for one trip: {' and '.join(map(str, paths))}; remove or rename one")
    require_plain_name(name, f"{paths[0]}: the file's name, which names the trip,")
    if has_drive(out, name, name, database.layout):
        return None
    trip = trip_from_table(read_table(paths[0]), vehicle=name, name=name, ranges=signal_ranges(database))
    write_drive(out, trip.drive, database.layout)
    return trip


def trip_from_table(table: Table, *, vehicle: str, name: str, ranges: Mapping[str, SignalRange]) -> ImportedTrip:
    """Turn one file into a drive.

    Parameters
    ----------
    table : Table
        The file.
    vehicle, name : str
        Identity of vehicle and drive.
    ranges : mapping of str to SignalRange
        Ranges that the DBC allows, by branch and input; a channel without a range may have any value.

    Returns
    -------
    ImportedTrip
        Drive with the branches of :data:`BRANCHES` and the inputs of :data:`INPUTS`.

    Raises
    ------
    LogError
        If a column is missing.
    DriveError
        If the file is too short, or the battery current, of which the motor's is made, has no usable value.
    """
    columns = {key: table.columns[table.column(header)] for key, header in COLUMNS.items()}
    time_s = table.time_s
    if time_s[-1] < SHORTEST_S:
        raise DriveError(f"{table.path}: only {time_s[-1]:.1f} s long; at least {SHORTEST_S:g} s are needed")
    notices = [
        f"column '{COLUMNS[key]}': {np.sum(bad)} cells without a number, the first at {time_s[np.argmax(bad)]:.1f} s; "
        f"labelled as not good"
        for key, values in columns.items()
        if (bad := ~np.isfinite(values)).any()
    ]
    voltage = np.where(columns["voltage"] > 0.0, columns["voltage"], np.nan)
    heater_w, aircon_w = 1e3 * columns["heater"], 1e3 * columns["aircon"]
    battery, auxiliary = -columns["current"], -(heater_w + aircon_w) / voltage
    values = {"battery": battery, "auxiliary": auxiliary, "motor": -(battery + auxiliary), "voltage": voltage}
    values |= {"heater_demand": heater_w, "aircon_demand": aircon_w}
    values |= {key: columns[key] for key in ("torque", "speed", "acceleration", "accelerator")}
    good = {key: np.isfinite(value) for key, value in values.items()}
    good["heater_demand"] &= _heater_good(columns, notices)
    for key, limits in ranges.items():
        beyond = good[key] & ~limits.holds(values[key]) if key in values else np.zeros(0, bool)
        if beyond.any():
            good[key][beyond] = False
            notices.append(
                f"{key}: {np.sum(beyond)} samples beyond the DBC's {limits.low:g} to {limits.high:g}; "
                f"labelled as not good"
            )
    for key, sources in _MADE_OF.items():
        good[key] &= np.logical_and.reduce([good[source] for source in sources])
    if not good["battery"].any():
        raise DriveError(f"{table.path}: column '{COLUMNS['current']}' has no usable value; leave the file out")
    channels = {key: Channel(time_s=time_s, value=value, good=good[key]) for key, value in values.items()}
    drive = Drive(
        vehicle=vehicle,
        name=name,
        branches={key: channels[key] for key in BRANCHES},
        inputs={key: channels[key] for key in INPUTS},
    )
    return ImportedTrip(drive=drive, notices=tuple(notices))


def _heater_good(columns: Mapping[str, Array], notices: list[str]) -> Mask:
    """Return where the heater's power is credible; add to the notices why it is not elsewhere."""
    default = _defaults(columns["heater"])
    spoilt = _with_ramps(default, columns["heater"])
    if default.any():
        notices.append(
            f"heater power reads its default of {HEATER_DEFAULT_KW} kW {_runs(default)} times: "
            f"{np.sum(spoilt)} samples of {_HEATER_CHANNELS} not good"
        )
    power_w = -columns["voltage"] * columns["current"] - 1e3 * (columns["heater"] + columns["aircon"])
    idle = ~spoilt & (np.abs(columns["torque"]) < IDLE_TORQUE_NM) & np.isfinite(power_w)
    if np.sum(idle) < _JUDGED_SAMPLES:
        notices.append("heater power not judged: the inverter is never idle for long")
        return ~spoilt
    rest_w = float(np.median(power_w[idle]))
    if rest_w >= LEAST_DCDC_W:
        return ~spoilt
    notices.append(
        f"heater power is implausible over the whole trip: with the inverter idle it leaves {rest_w:.0f} W for the "
        f"DC/DC converter, at least {LEAST_DCDC_W:.0f} W expected; no sample of {_HEATER_CHANNELS} is good"
    )
    return np.zeros_like(spoilt)


def _defaults(heater_kw: Array) -> Mask:
    """Return where the heater's power is its default, or jumps to nearly that: interpolation cut the default short."""
    exact = np.abs(heater_kw - HEATER_DEFAULT_KW) < HEATER_RESOLUTION_KW
    jump = np.abs(np.diff(heater_kw)) > IMPOSSIBLE_JUMP_KW
    beside_jump = np.concatenate([jump, [False]]) | np.concatenate([[False], jump])
    near = np.abs(heater_kw - HEATER_DEFAULT_KW) < NEAR_DEFAULT_KW
    return np.asarray(exact | (beside_jump & near))


def _with_ramps(default: Mask, heater_kw: Array) -> Mask:
    """Return the defaults together with the straight lines that lead to or from them."""
    step = np.diff(heater_kw)
    bend = np.abs(np.diff(step, prepend=0.0)) > 4.2 * HEATER_RESOLUTION_KW
    line = np.cumsum(bend)
    edge = default[1:] != default[:-1]
    touching = np.convolve(edge, np.ones(3), mode="same") > 0.0  # a line may end between two samples
    ramp = np.isin(line, line[touching & (step != 0.0)]) & (step != 0.0)
    spoilt = default.copy()
    spoilt[1:] |= ramp
    spoilt[:-1] |= ramp
    return spoilt


def _runs(mask: Mask) -> int:
    """Count the runs of samples that are True."""
    return int(np.sum(np.diff(mask.astype(np.int8), prepend=0) == 1))


def signal_ranges(database: VehicleDatabase) -> dict[str, SignalRange]:
    """Return the ranges that the DBC gives to branches and inputs.

    Parameters
    ----------
    database : VehicleDatabase
        DBC and layout.

    Returns
    -------
    dict of str to SignalRange
        By name: branches in A, positive into the junction; inputs in the unit of the DBC. Branches that are computed
        from a power are absent.
    """
    layout = database.layout
    ranges = {item.name: signal_range(database.signal(item.signal)[1]) for item in layout.input}
    for branch in layout.branch:
        if branch.signal is not None:
            _, signal = database.signal(branch.signal)
            factor = branch.sign * unit_factor(signal, AMPERE, f"{layout.path}: branch {branch.name}")
            ranges[branch.name] = signal_range(signal, factor)
    return ranges


if __name__ == "__main__":
    run_tool(app, "import_bmw_i3")
