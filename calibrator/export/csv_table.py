"""CSV (RFC 4180): one row per branch, of one vehicle or many in one table.

Drifts are pure numbers, currents are in A, positive into the junction; empty: not known, or does not apply.
"""

import csv
import io
from collections.abc import Sequence

from calibrator.errors import ExportError
from calibrator.export.checked import Checked
from ecu_node.core.correction import NO_FAULT
from ecu_node.errors import printable

__all__ = ["csv_text"]

_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")
"""With these a spreadsheet takes a text for a formula, which may fetch and run what it likes."""


def csv_text(tables: Sequence[Checked]) -> str:
    """Write parameter files as one table.

    Parameters
    ----------
    tables : sequence of Checked
        The parameter files, at least one.

    Returns
    -------
    str
        The table with its header, lines ended by CR LF; drifts and offsets are those that were found, corrected or not.

    Raises
    ------
    ExportError
        If a text, such as the vehicle's name, would be a formula in a spreadsheet.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\r\n")
    for checked in tables:
        for name in checked.parameters.branches:
            row = _row(checked, name)
            if not text.tell():
                writer.writerow(row)
            writer.writerow([_cell(value, column, checked) for column, value in row.items()])
    return text.getvalue()


def _row(checked: Checked, name: str) -> dict[str, str | float | bool | None]:
    found, source = checked.parameters.branches[name], checked.database.layout.find_branch(name).source
    return {
        "vehicle": checked.parameters.vehicle,
        "parameter_set": checked.parameters.number,
        "branch": name,
        "signal": source,
        "signal_unit": checked.database.signal(source)[1].unit,
        "drift": found.drift,
        "drift_sd": found.drift_sd,
        "offset_a": found.offset_a,
        "offset_sd_a": found.offset_sd_a,
        "applied": checked.fault(name) is not NO_FAULT,
        "held_back": found.held_back,
        "delay_s": found.delay_s,
        "delay_sd_s": found.delay_sd_s,
        "fault_probability": found.fault_probability,
        "harm_probability": found.harm_probability,
        "identifiable": found.identifiable,
        "verdict": checked.parameters.verdict,
        "confidence": checked.parameters.confidence,
        **checked.provenance,
    }


def _cell(value: str | float | bool | None, column: str, checked: Checked) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str) and value.startswith(_FORMULA):
        try:
            float(value)
        except ValueError:
            raise ExportError(
                f"{printable(checked.name)}: {column} {value!r} begins as a formula does, which a spreadsheet would "
                f"work out; rename it"
            ) from None
    return "" if value is None else str(value)
