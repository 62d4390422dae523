"""ASAM CDF 2.0, calibration data as XML (``.cdfx``).

One SW-SYSTEM with one tree of instances: numbers are of category VALUE, truth values BOOLEAN, texts ASCII. Each
instance belongs to the feature of its branch, and has one entry of history that says where it comes from. CDF has no
element for a range; the limits of the layout are special data (SD) of that entry.
"""

import xml.etree.ElementTree as ET

from calibrator.export.characteristics import Characteristic, Note, characteristics, notes
from calibrator.export.checked import Checked
from ecu_node import __version__
from ecu_node.errors import printable

__all__ = ["cdfx_document"]

_GENERAL = "general"
"""Feature of what belongs to no branch; those of branches have a dot."""


def cdfx_document(checked: Checked) -> bytes:
    """Write a parameter file as CDFX.

    Parameters
    ----------
    checked : Checked
        The parameter file.

    Returns
    -------
    bytes
        The XML document, UTF-8.

    Raises
    ------
    ExportError
        If a text, such as the vehicle's name, has a character that the format cannot hold.
    """
    texts = notes(checked)
    root = ET.Element("MSRSW", {"CREATOR": "calibrator", "CREATOR-VERSION": __version__})
    _add(root, "SHORT-NAME", "HV_current_correction")
    _add(root, "CATEGORY", "CDF20")
    system = ET.SubElement(ET.SubElement(root, "SW-SYSTEMS"), "SW-SYSTEM")
    _add(system, "SHORT-NAME", printable(checked.database.layout.name))
    tree = ET.SubElement(ET.SubElement(system, "SW-INSTANCE-SPEC"), "SW-INSTANCE-TREE")
    _add(tree, "SHORT-NAME", checked.provenance["vehicle"])
    _add(tree, "CATEGORY", "NO_VCD")
    origin = ET.SubElement(tree, "SW-INSTANCE-TREE-ORIGIN")
    _add(origin, "SYMBOLIC-FILE", printable(checked.database.layout.path.name))
    _add(origin, "DATA-FILE", printable(checked.name))
    _add_features(tree, checked)
    for note in texts:
        _add_text(tree, note, checked)
    for item in characteristics(checked):
        _add_number(tree, item, checked)
    ET.indent(root)
    content: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return content + b"\n"


def _add(parent: ET.Element, tag: str, text: str) -> None:
    ET.SubElement(parent, tag).text = text


def _feature(branch: str) -> str:
    return f"HV.{branch}"


def _add_features(tree: ET.Element, checked: Checked) -> None:
    collections = ET.SubElement(tree, "SW-CS-COLLECTIONS")
    for name in (_GENERAL, *map(_feature, checked.parameters.branches)):
        collection = ET.SubElement(collections, "SW-CS-COLLECTION")
        _add(collection, "CATEGORY", "FEATURE")
        _add(collection, "SW-FEATURE-REF", name)
        _add(collection, "REVISION", str(checked.parameters.number))


def _add_text(tree: ET.Element, note: Note, checked: Checked) -> None:
    instance = _instance(tree, note.name, note.text, "ASCII", _GENERAL)
    _add(ET.SubElement(ET.SubElement(instance, "SW-VALUE-CONT"), "SW-VALUES-PHYS"), "VT", note.value)
    _add_history(instance, checked, {})


def _add_number(tree: ET.Element, item: Characteristic, checked: Checked) -> None:
    is_truth = isinstance(item.value, bool)
    category = "BOOLEAN" if is_truth else "VALUE"
    instance = _instance(tree, item.name, f"{item.branch}: {item.text}", category, _feature(item.branch))
    container = ET.SubElement(instance, "SW-VALUE-CONT")
    _add(container, "UNIT-DISPLAY-NAME", item.unit)
    values = ET.SubElement(container, "SW-VALUES-PHYS")
    if is_truth:
        _add(values, "VT", "true" if item.value else "false")
    else:
        _add(values, "V", repr(item.value))
    ends = zip(("LOWER-LIMIT", "UPPER-LIMIT"), map(repr, item.limits), strict=True) if item.limits is not None else ()
    _add_history(instance, checked, dict(ends))


def _instance(tree: ET.Element, name: str, text: str, category: str, feature: str) -> ET.Element:
    instance = ET.SubElement(tree, "SW-INSTANCE")
    _add(instance, "SHORT-NAME", name)
    _add(instance, "LONG-NAME", text)
    _add(instance, "CATEGORY", category)
    _add(instance, "SW-FEATURE-REF", feature)
    return instance


def _add_history(instance: ET.Element, checked: Checked, special: dict[str, str]) -> None:
    """One entry: user (CSUS), project (CSPR), work package (CSWP), test object (CSTO), program, data (CSPI, CSDI)."""
    known = checked.provenance
    entry = ET.SubElement(ET.SubElement(instance, "SW-CS-HISTORY"), "CS-ENTRY")
    _add(entry, "STATE", "calibrated")
    _add(entry, "DATE", known["created"])
    _add(entry, "CSUS", known["tool"])
    _add(entry, "CSPR", known["fleet"])
    _add(entry, "CSWP", known["method"])
    _add(entry, "CSTO", known["vehicle"])
    _add(entry, "CSPI", known["layout_sha256"])
    _add(entry, "CSDI", f"{checked.parameters.number} {known['parameters_sha256']}")
    _add(ET.SubElement(entry, "REMARK"), "P", f"verdict: {known['verdict']}")
    for name, value in special.items():
        ET.SubElement(entry, "SD", {"GID": name}).text = value
