"""CSV (RFC 4180): one row per branch, of one vehicle or many in one table."""

import csv
import io
from collections.abc import Sequence

from calibrator.errors import ExportError
from calibrator.export.checked import Checked
from ecu_node.errors import printable
from ecu_node.parameters import BranchParameters

__all__ = ["COLUMNS", "csv_text"]

COLUMNS = (
    "vehicle",
    "parameter_set",
    "branch",
    "signal",
    "signal_unit",
    "drift",
    "drift_sd",
    "offset_a",
    "offset_sd_a",
    "applied",
    "held_back",
    "delay_s",
    "delay_sd_s",
    "fault_probability",
    "harm_probability",
    "identifiable",
    "verdict",
    "confidence",
    "tool",
    "method",
    "created",
    "fleet",
    "parameters_sha256",
    "layout_sha256",
    "dbc_sha256",
)
"""Drifts are pure numbers, currents are in A, positive into the junction; empty: not known, or does not apply."""

_Cell = str | float | bool | None
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")
"""With these a spreadsheet takes a text for a formula, which may fetch and run what it likes."""


def csv_text(tables: Sequence[Checked]) -> str:
    """Write parameter files as one table.

    Parameters
    ----------
    tables : sequence of Checked
        The parameter files.

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
    writer = csv.DictWriter(text, COLUMNS, restval="", lineterminator="\r\n")
    writer.writeheader()
    for checked in tables:
        for name, found in checked.parameters.branches.items():
            row = _row(checked, name, found)
            writer.writerow({column: _cell(value, column, checked) for column, value in row.items()})
    return text.getvalue()


def _cell(value: _Cell, column: str, checked: Checked) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str) and value.startswith(_FORMULA) and not _is_number(value):
        raise ExportError(
            f"{printable(checked.name)}: {column} {value!r} begins as a formula does, which a spreadsheet would work "
            f"out; rename it"
        )
    return "" if value is None else str(value)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _row(checked: Checked, name: str, found: BranchParameters) -> dict[str, _Cell]:
    branch = checked.database.layout.find_branch(name)
    _, signal = checked.database.signal(branch.source)
    return {
        **checked.provenance,
        "confidence": checked.parameters.confidence,
        "branch": name,
        "signal": branch.source,
        "signal_unit": signal.unit,
        "drift": found.drift,
        "drift_sd": found.drift_sd,
        "offset_a": found.offset_a,
        "offset_sd_a": found.offset_sd_a,
        "applied": checked.is_applied(name),
        "held_back": found.held_back,
        "delay_s": found.delay_s,
        "delay_sd_s": found.delay_sd_s,
        "fault_probability": found.fault_probability,
        "harm_probability": found.harm_probability,
        "identifiable": found.identifiable,
    }
