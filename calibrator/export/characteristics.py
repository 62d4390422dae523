"""What calibration tools call characteristics: named numbers with unit and range, made of one parameter file.

``HV.BRANCH.drift`` and its like are what is to be corrected: 0 where the node passes the branch through, so that a
control unit that knows nothing of "held back" corrects nothing either. What was found stands beside it,
``HV.BRANCH.found.drift``. Currents are positive into the junction.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from calibrator.errors import ExportError
from calibrator.export.checked import Checked
from ecu_node.parameters import BranchParameters

__all__ = ["Characteristic", "Note", "characteristics", "notes"]

_NO_UNIT = "-"
_FORBIDDEN = '"\\'
"""DCM has no agreed way to write these in a text."""


@dataclass(frozen=True, kw_only=True)
class Characteristic:
    """One number or truth value.

    Attributes
    ----------
    name : str
        Unique; letters, digits, underscores and dots.
    text : str
        What it is, in one line of ASCII.
    branch : str
        Whose it is.
    unit : str
        "-" for a pure number.
    value : float or bool
        In that unit.
    limits : tuple of float or None
        Least and greatest value that the layout allows, if it says so.
    """

    name: str
    text: str
    branch: str
    unit: str = _NO_UNIT
    value: float | bool
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Note:
    """One text about the whole file, such as the vehicle."""

    name: str
    text: str
    value: str


def characteristics(checked: Checked) -> list[Characteristic]:
    """All characteristics of a parameter file, branch by branch.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    list of Characteristic
        In the order of the file.
    """
    return [
        item
        for branch, found in checked.parameters.branches.items()
        for item in (*_in_force(checked, branch, found), *_found(branch, found))
    ]


def notes(checked: Checked) -> list[Note]:
    """Where a parameter file comes from.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    list of Note
        Vehicle, digests and the like.

    Raises
    ------
    ExportError
        If a text has a character that not every format can hold.
    """
    found = []
    for key, value in checked.provenance.items():
        if not value.isprintable() or any(letter in value for letter in _FORBIDDEN):
            raise ExportError(
                f"{checked.name}: {key} {value!r} has a quotation mark, a backslash or a control character, which "
                f"calibration formats cannot hold; rename it, or export CSV"
            )
        found.append(Note(name=f"HV.{key}", text=key.replace("_", " "), value=value))
    return found


def _in_force(checked: Checked, branch: str, found: BranchParameters) -> Iterator[Characteristic]:
    """What is corrected: zeros where nothing is."""
    layout, applied = checked.database.layout, checked.is_applied(branch)
    numbers = (
        ("drift", "measured = (1 + drift) * true + offset", _NO_UNIT, found.drift, layout.limits.drift),
        ("offset", "offset, positive into the junction", "A", found.offset_a, layout.offset_limit_a),
    )
    yield Characteristic(name=f"HV.{branch}.applied", text="whether it is corrected", branch=branch, value=applied)
    for name, text, unit, value, limit in numbers:
        yield Characteristic(
            name=f"HV.{branch}.{name}",
            text=text,
            branch=branch,
            unit=unit,
            value=value if applied else 0.0,
            limits=(-limit, limit),
        )


def _found(branch: str, found: BranchParameters) -> Iterator[Characteristic]:
    """What was found, corrected or not."""
    numbers = (
        ("drift", "drift that was found", _NO_UNIT, found.drift),
        ("drift_sd", "its standard deviation", _NO_UNIT, found.drift_sd),
        ("offset", "offset that was found", "A", found.offset_a),
        ("offset_sd", "its standard deviation", "A", found.offset_sd_a),
        ("delay", "how much later than the largest branch it is seen", "s", found.delay_s),
    )
    for name, text, unit, value in numbers:
        if value is not None:
            yield Characteristic(name=f"HV.{branch}.found.{name}", text=text, branch=branch, unit=unit, value=value)
