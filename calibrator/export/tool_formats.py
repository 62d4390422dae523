"""Files for calibration tools: named numbers with unit and range, as DCM 2.0, ASAM CDF 2.0 (``.cdfx``) and A2L.

``HV.BRANCH.gain`` and the like are the flashed numbers, whose addresses the A2L gives. ``HV.BRANCH.drift`` and
``.offset`` say the same in physical units, for people, and ``HV.BRANCH.found...`` is the fault that was found, whether
corrected or not. Currents are positive into the junction.
"""

import itertools
from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

from calibrator.errors import ExportError
from calibrator.export.core import FRACTION_BITS, BranchValues, Checked, Image, branch_values, rendered, scaled_plan
from ecu_node import __version__
from ecu_node.core.correction import NO_FAULT, SensorFault
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Branch

__all__ = ["Characteristic", "a2l_text", "cdfx_text", "characteristics", "dcm_text"]

_FUNCTION = "HV_current_correction"
_FORBIDDEN = '"\\'
"""Characters that DCM has no agreed way to write in a text."""


class _Field(NamedTuple):
    """How one number of :class:`BranchValues` is described to tools."""

    text: str
    unit: str
    bits: int
    """Fractional bits."""
    record_layout: str
    compu_method: str


_FIELDS = {
    "gain": _Field("corrected code per measured code", "-", FRACTION_BITS, "HV.signed", "HV.fixed_point"),
    "voltage_gain": _Field("corrected code per code of the voltage", "-", FRACTION_BITS, "HV.signed", "HV.fixed_point"),
    "bias": _Field("added to the code, whole codes", "code", 0, "HV.signed", "HV.code"),
    "fraction": _Field("added, less than one code", "code", FRACTION_BITS, "HV.unsigned", "HV.fixed_point_code"),
    "applied": _Field("whether it is corrected", "-", 0, "HV.unsigned", "HV.truth"),
}


def _fields(branch: Branch) -> list[str]:
    """Return the names of the numbers that a branch has; ``voltage_gain`` only if a voltage divides its power."""
    return [name for name in _FIELDS if name != "voltage_gain" or branch.voltage is not None]


class Characteristic(NamedTuple):
    """One number or truth value, as calibration tools show it.

    Attributes
    ----------
    name : str
        Unique; letters, digits, underscores and dots.
    text : str
        Description in one line of ASCII.
    branch : str
        Name of its branch; empty if it belongs to the whole vehicle.
    unit : str
        Unit; "-" for a pure number.
    value : float, int or bool
        Value in that unit.
    """

    name: str
    text: str
    branch: str
    unit: str
    value: float | bool

    @property
    def full_text(self) -> str:
        """The text, preceded by the name of the branch or "vehicle"."""
        return f"{self.branch or 'vehicle'}: {self.text}"


def characteristics(checked: Checked) -> list[Characteristic]:
    """Return all numbers and truth values of a parameter file for calibration tools, branch by branch.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    list of Characteristic
        Those of the vehicle, then those of each branch, in the order of the layout.

    Raises
    ------
    ExportError
        If a number of the C core is not exact in floating point, which tools use, or does not fit into its integers.
    """
    found = [Characteristic("HV.parameter_set", "number of the parameter set", "", "-", checked.parameters.number)]
    for branch in checked.database.layout.branch:
        found += _flashed(checked, branch)
        found += _for_people(checked, branch.name)
    return found


def _flashed(checked: Checked, branch: Branch) -> Iterator[Characteristic]:
    values = branch_values(checked.database, branch, checked.parameters.fault(branch.name))
    for field in _fields(branch):
        number, (text, unit, bits, *_) = getattr(values, field), _FIELDS[field]
        exact = Fraction(number, 1 << bits)
        value: float | bool = bool(number) if field == "applied" else number if bits == 0 else float(exact)
        if Fraction(value) != exact:
            raise ExportError(
                f"{checked.name}: branch {branch.name}: {field} has more digits than the floating-point numbers of "
                f"calibration tools; flash it with --format hex"
            )
        yield Characteristic(f"HV.{branch.name}.{field}", text, branch.name, unit, value)


def _for_people(checked: Checked, branch: str) -> Iterator[Characteristic]:
    fault, found = checked.parameters.fault(branch), checked.parameters.branches.get(branch)
    rows: list[tuple[str, str, str, float | None]] = [
        ("drift", "measured = (1 + drift) * true + offset", "-", fault.drift),
        ("offset", "offset, positive into the junction", "A", fault.offset_a),
    ]
    if found is not None:
        rows += [
            ("found.drift", "drift that was found", "-", found.drift),
            ("found.drift_sd", "its standard deviation", "-", found.drift_sd),
            ("found.offset", "offset that was found", "A", found.offset_a),
            ("found.offset_sd", "its standard deviation", "A", found.offset_sd_a),
            ("found.delay", "how much later than the largest branch it is seen", "s", found.delay_s),
        ]
    for name, text, unit, value in rows:
        if value is not None:
            yield Characteristic(f"HV.{branch}.{name}", text, branch, unit, value)


def _notes(checked: Checked) -> dict[str, str]:
    """Return texts about the whole file, such as ``{"vehicle": "V001"}``; ExportError if tools cannot hold one."""
    texts = {key: value for key, value in checked.provenance.items() if key != "parameter_set"}
    for key, value in texts.items():
        if not value.isprintable() or any(letter in value for letter in _FORBIDDEN):
            raise ExportError(
                f"{checked.name}: {key} {value!r} has a quotation mark, a backslash or a control character, which "
                f"calibration formats cannot hold; rename it"
            )
    return texts


def dcm_text(checked: Checked) -> str:
    """Write a parameter file as DCM 2.0, the text format of ETAS and Bosch ("Konservierung").

    Numbers are FESTWERT, texts TEXTSTRING; all belong to one function, whose version is the number of the parameter
    set. The order of the keywords is that of the grammar ``dcm/DCM_2_0_grammar.g4`` of antlr/grammars-v4.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    str
        The file, lines ended by LF; to be encoded as UTF-8.

    Raises
    ------
    ExportError
        If a text has a character that the format cannot hold, or in the cases of :func:`characteristics`.
    """
    return rendered(
        "parameters.dcm",
        function=_FUNCTION,
        parameter_set=checked.parameters.number,
        notes=_notes(checked),
        items=characteristics(checked),
    )


def cdfx_text(checked: Checked) -> str:
    """Write a parameter file as ASAM CDF 2.0, calibration data as XML.

    Numbers are of category VALUE, truth values BOOLEAN, texts ASCII. Each instance belongs to the feature of its branch
    and has one entry of history that says where it comes from.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    str
        The XML document, to be encoded as UTF-8.

    Raises
    ------
    ExportError
        In the cases of :func:`dcm_text`.
    """
    rows = [(f"HV.{key}", key, "ASCII", "general", "", value) for key, value in _notes(checked).items()]
    for item in characteristics(checked):
        is_truth, feature = isinstance(item.value, bool), f"HV.{item.branch}" if item.branch else "general"
        category, value = ("BOOLEAN", str(item.value).lower()) if is_truth else ("VALUE", repr(item.value))
        rows.append((item.name, item.full_text, category, feature, item.unit, value))
    layout = checked.database.layout
    return rendered(
        "parameters.cdfx",
        version=__version__,
        function=_FUNCTION,
        layout=layout,
        file=checked.name,
        known=checked.provenance,
        features=["general", *(f"HV.{branch}" for branch in layout.branch_names)],
        rows=rows,
    )


def a2l_text(database: VehicleDatabase, image: Image) -> str:
    """Describe the calibration in a compiled program as A2L (ASAP2 1.7.1), the same for all vehicles of a layout.

    Parameters
    ----------
    database : VehicleDatabase
        Layout and DBC.
    image : Image
        Where the calibration stands.

    Returns
    -------
    str
        The file, ASCII. Limits are those of all parameters that the layout allows.

    Raises
    ------
    ExportError
        If a signal is too wide for the core.
    """
    number = _Field("number of the parameter set", "-", 0, "HV.unsigned", "HV.number")
    items: list[tuple[object, ...]] = [("HV.parameter_set", number.text, image.address + 8, number, (0, (1 << 53) - 1))]
    for k, branch in enumerate(database.layout.branch):
        extremes = _extremes(database, branch)
        for name in _fields(branch):
            field, values, limits = _FIELDS[name], [getattr(item, name) for item in extremes], (0.0, 1.0)
            if name not in {"fraction", "applied"}:
                slack = 1 << max(0, field.bits - 30)  # plans between the corners may be rounded differently
                ends = max(min(values) - slack, -(1 << 63)), min(max(values) + slack, (1 << 63) - 1)
                limits = (ends[0] / (1 << field.bits), ends[1] / (1 << field.bits))
            address = image.address + 8 * (2 + len(_FIELDS) * k + list(_FIELDS).index(name))
            items.append((f"HV.{branch.name}.{name}", f"{branch.name}: {field.text}", address, field, limits))
    return rendered("core.a2l", function=_FUNCTION, order=image.order, bits=FRACTION_BITS, items=items)


def _extremes(database: VehicleDatabase, branch: Branch) -> list[BranchValues]:
    """Return the numbers for no correction and for the corners of the layout's limits, between which all others lie."""
    limits = database.layout.limits.drift, database.layout.offset_limit_a
    corners = itertools.product(*((-limit, limit) for limit in limits))
    faults = [NO_FAULT, *(SensorFault(drift=drift, offset_a=offset) for drift, offset in corners)]
    return [scaled_plan(database, branch, fault) for fault in faults]
