"""Branch currents of one vehicle over a minute: measured, corrected and ideal.

On the unity window a vehicle's sensors show a_k f_k(u) + b_k, by its own slopes and intercepts (15) over the ideal
currents f of the fleet; on a drive of its own they show what was recorded. Corrected are (25) both, in [1]_.

.. [1] "Measurement Correction for Electric Vehicles Based on Compressed Sensing".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibrator.drive import Array, DriveFile
from calibrator.drives.align import align
from calibrator.drives.delays import without_delays
from calibrator.errors import FleetError
from calibrator.estimator.vehicle_evidence import VehicleEvidence
from calibrator.report.window import IdealWindow
from calibrator.sources.fleet_source import find_fleet, load_drive
from calibrator.summaries.unity import WINDOW_S, UnityWindow, liveliest_window
from calibrator.terminal.text import few
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout
from ecu_node.parameters import VehicleParameters

__all__ = ["Traces", "recorded_traces", "unity_traces"]


@dataclass(frozen=True, kw_only=True)
class Traces:
    """Currents of one vehicle.

    Attributes
    ----------
    title : str
        Which drive.
    branches : sequence of str
        Names of the K branches.
    time_s : ndarray of shape (T,)
        Instants from 0. [s]
    measured_a, corrected_a : ndarray of shape (T, K)
        Before and after correction with what the node applies; NaN where not valid. [A]
    ideal_a : ndarray of shape (T, K) or None
        Of the fleet; None: not known on this drive. [A]
    """

    title: str
    branches: Sequence[str]
    time_s: Array
    measured_a: Array
    corrected_a: Array
    ideal_a: Array | None


def unity_traces(
    parameters: VehicleParameters, evidence: VehicleEvidence, names: Sequence[str], window: IdealWindow
) -> Traces:
    """Currents that a vehicle's sensors show on the unity window.

    Parameters
    ----------
    parameters : VehicleParameters
        Of the vehicle.
    evidence : VehicleEvidence
        Its slopes and intercepts.
    names : sequence of str
        Of the rows of the evidence.
    window : IdealWindow
        Ideal currents.

    Returns
    -------
    Traces
        Branches in the order of the parameters.
    """
    branches = tuple(parameters.branches)
    slope, intercept_a = (
        np.array([_row(evidence, names, f"{what} {name}") for name in branches]) for what in ("slope", "intercept")
    )
    measured_a = slope * window.ideal_a + intercept_a
    return Traces(
        title=f"unity window: a minute of the inputs of vehicle {window.vehicle}",
        branches=branches,
        time_s=window.time_s,
        measured_a=measured_a,
        corrected_a=_corrected(measured_a, parameters),
        ideal_a=window.ideal_a,
    )


def recorded_traces(
    parameters: VehicleParameters, fleet: Path, database: VehicleDatabase, unity: UnityWindow | None, read_out: Array
) -> Traces:
    """Currents as a vehicle recorded them, where they vary most.

    Parameters
    ----------
    parameters : VehicleParameters
        Of the vehicle; its delays are taken out.
    fleet : Path
        Its drives, see :func:`calibrator.sources.fleet_source.find_fleet`.
    database : VehicleDatabase
        DBC and layout.
    unity : UnityWindow or None
        Knows the fleet's filter bank; None: no ideal currents.
    read_out : ndarray of shape (W + 1, K)
        Of the fleet model; empty if it is not known. [A]

    Returns
    -------
    Traces
        A minute of the first drive that has one.

    Raises
    ------
    UserError
        If the vehicle has no drive there, or none with a minute of valid samples.
    """
    found = find_fleet(fleet).vehicles
    if parameters.vehicle not in found:
        raise FleetError(f"{fleet}: no drive of vehicle {parameters.vehicle}; it has those of {few(sorted(found))}")
    for entry in found[parameters.vehicle]:
        traces = _traces_of(entry, parameters, database, unity, read_out)
        if traces is not None:
            return traces
    raise FleetError(f"{fleet}: no drive of vehicle {parameters.vehicle} has {WINDOW_S:g} s of valid samples in a row")


def _traces_of(
    entry: DriveFile,
    parameters: VehicleParameters,
    database: VehicleDatabase,
    unity: UnityWindow | None,
    read_out: Array,
) -> Traces | None:
    branches, layout = tuple(parameters.branches), database.layout
    delays = {name: branch.delay_s for name, branch in parameters.branches.items() if branch.delay_s}
    drive = without_delays(load_drive(entry, database), delays)
    known = unity is not None and len(read_out) and set(unity.bank.input_names) <= _inputs(layout)
    samples = align(drive, layout, branches, inputs=unity.bank.input_names if known and unity is not None else ())
    length = round(WINDOW_S / layout.period_s)
    start = liveliest_window(samples.currents_a, samples.valid, length)
    if start is None:
        return None
    window = slice(start, start + length)
    ideal_a = None
    if known and unity is not None:
        columns, used = unity.bank.run(samples.inputs, samples.valid, unity.bank.start())
        ideal_a = np.column_stack([np.where(used[:, None], columns, np.nan), np.ones(len(columns))])[window] @ read_out
    measured_a = samples.currents_a[window]
    return Traces(
        title=f"drive {entry.name}, from {samples.time_s[start]:.0f} s",
        branches=branches,
        time_s=samples.time_s[window] - samples.time_s[start],
        measured_a=measured_a,
        corrected_a=_corrected(measured_a, parameters),
        ideal_a=ideal_a,
    )


def _inputs(layout: Layout) -> set[str]:
    return {item.name for item in layout.input} | {item.name for item in layout.derived}


def _corrected(measured_a: Array, parameters: VehicleParameters) -> Array:
    """Correct with what the node applies (25)."""
    branches = parameters.branches.values()
    gain = np.array([1.0 + branch.drift if branch.apply else 1.0 for branch in branches])
    offset_a = np.array([branch.offset_a if branch.apply else 0.0 for branch in branches])
    return np.asarray((measured_a - offset_a) / gain)


def _row(evidence: VehicleEvidence, names: Sequence[str], name: str) -> float:
    """A row of the evidence; what explains it where the recordings do not tell it."""
    r = names.index(name)
    value = evidence.value[r]
    return evidence.explained[r] if value is None else value
