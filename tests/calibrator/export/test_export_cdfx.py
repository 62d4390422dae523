"""CDFX: elements in the order of ASAM's DTD of CDF 2.0, and values, units, limits and provenance as in the file."""

import dataclasses
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from msgspec.structs import replace

from calibrator.errors import ExportError
from calibrator.export.cdfx import cdfx_document
from calibrator.export.checked import Checked
from ecu_node import __version__
from ecu_node.database import VehicleDatabase
from tests.calibrator.export.exports import checked_with, held_back, parameters_for

ORDER = {
    "MSRSW": ["SHORT-NAME", "CATEGORY", "SW-SYSTEMS"],
    "SW-SYSTEMS": ["SW-SYSTEM"],
    "SW-SYSTEM": ["SHORT-NAME", "SW-INSTANCE-SPEC"],
    "SW-INSTANCE-SPEC": ["SW-INSTANCE-TREE"],
    "SW-INSTANCE-TREE": [
        "SHORT-NAME",
        "CATEGORY",
        "SW-INSTANCE-TREE-ORIGIN",
        "SW-CS-COLLECTIONS",
        "SW-INSTANCE",
    ],
    "SW-INSTANCE-TREE-ORIGIN": ["SYMBOLIC-FILE", "DATA-FILE"],
    "SW-CS-COLLECTIONS": ["SW-CS-COLLECTION"],
    "SW-CS-COLLECTION": ["CATEGORY", "SW-FEATURE-REF", "REVISION"],
    "SW-INSTANCE": ["SHORT-NAME", "LONG-NAME", "CATEGORY", "SW-FEATURE-REF", "SW-VALUE-CONT", "SW-CS-HISTORY"],
    "SW-VALUE-CONT": ["UNIT-DISPLAY-NAME", "SW-VALUES-PHYS"],
    "SW-VALUES-PHYS": ["VT", "V"],
    "SW-CS-HISTORY": ["CS-ENTRY"],
    "CS-ENTRY": ["STATE", "DATE", "CSUS", "CSPR", "CSWP", "CSTO", "CSPI", "CSDI", "REMARK", "SD"],
    "REMARK": ["P"],
}
"""Children of each element that the export writes, in the order of the DTD."""
REPEATED = {"SW-INSTANCE", "SW-CS-COLLECTION", "SD"}


@pytest.fixture
def checked(database: VehicleDatabase, tmp_path: Path) -> Checked:
    parameters = held_back(parameters_for(database, battery=(0.05, -1.23456789012345)), "motor")
    return checked_with(database, parameters, tmp_path)


@pytest.fixture
def document(checked: Checked) -> ET.Element:
    return ET.fromstring(cdfx_document(checked))


def instances(document: ET.Element) -> dict[str, ET.Element]:
    return {item.findtext("SHORT-NAME", ""): item for item in document.iter("SW-INSTANCE")}


def test_elements_stand_in_the_order_of_the_dtd(document: ET.Element) -> None:
    for element in document.iter():
        tags = [child.tag for child in element]
        order = ORDER.get(element.tag, [])
        assert tags == sorted(tags, key=order.index), element.tag
        once = [tag for tag in tags if tag not in REPEATED]
        assert len(once) == len(set(once)), element.tag


def test_the_document_says_what_it_is(document: ET.Element) -> None:
    assert document.findtext("CATEGORY") == "CDF20"
    assert document.attrib == {"CREATOR": "calibrator", "CREATOR-VERSION": __version__}
    tree = document.find("SW-SYSTEMS/SW-SYSTEM/SW-INSTANCE-SPEC/SW-INSTANCE-TREE")
    assert tree is not None
    assert (tree.findtext("SHORT-NAME"), tree.findtext("CATEGORY")) == ("v1", "NO_VCD")
    assert tree.findtext("SW-INSTANCE-TREE-ORIGIN/DATA-FILE") == "v1.json"


def test_numbers_have_units_and_are_exact(document: ET.Element) -> None:
    found = {
        name: (item.findtext("SW-VALUE-CONT/UNIT-DISPLAY-NAME"), float(item.findtext(".//V", "")))
        for name, item in instances(document).items()
        if item.findtext("CATEGORY") == "VALUE"
    }
    assert found == {
        "HV.battery.drift": ("-", 0.05),
        "HV.battery.offset": ("A", -1.23456789012345),
        "HV.battery.found.drift": ("-", 0.05),
        "HV.battery.found.offset": ("A", -1.23456789012345),
        "HV.motor.drift": ("-", 0.0),
        "HV.motor.offset": ("A", 0.0),
        "HV.motor.found.drift": ("-", 0.2),
        "HV.motor.found.drift_sd": ("-", 0.01),
        "HV.motor.found.offset": ("A", 7.0),
    }


def test_what_is_applied_is_a_truth_value(document: ET.Element) -> None:
    found = {name: item.findtext(".//VT") for name, item in instances(document).items() if "applied" in name}
    assert found == {"HV.battery.applied": "true", "HV.motor.applied": "false"}


def test_the_limits_of_the_layout_stand_in_the_history(document: ET.Element) -> None:
    drift, offset = (instances(document)[f"HV.battery.{name}"] for name in ("drift", "offset"))
    found = [[(item.attrib["GID"], item.text) for item in owner.iter("SD")] for owner in (drift, offset)]
    assert found == [
        [("LOWER-LIMIT", "-0.4"), ("UPPER-LIMIT", "0.4")],
        [("LOWER-LIMIT", "-150.0"), ("UPPER-LIMIT", "150.0")],
    ]


def test_every_instance_says_where_it_comes_from(document: ET.Element, checked: Checked) -> None:
    for item in instances(document).values():
        entry = item.find("SW-CS-HISTORY/CS-ENTRY")
        assert entry is not None
        assert [entry.findtext(tag) for tag in ("DATE", "CSUS", "CSTO", "CSDI")] == [
            "2026-01-01T00:00:00Z",
            "test",
            "v1",
            f"300 {checked.digest}",
        ]


def test_texts_are_those_of_the_file(document: ET.Element, checked: Checked) -> None:
    texts = {
        name.removeprefix("HV."): item.findtext("SW-VALUE-CONT/SW-VALUES-PHYS/VT")
        for name, item in instances(document).items()
        if item.findtext("CATEGORY") == "ASCII"
    }
    assert texts == checked.provenance


def test_features_that_instances_refer_to_are_declared(document: ET.Element) -> None:
    declared = {item.findtext("SW-FEATURE-REF") for item in document.iter("SW-CS-COLLECTION")}
    assert {item.findtext("SW-FEATURE-REF") for item in instances(document).values()} == declared


def test_names_with_signs_of_xml_survive(database: VehicleDatabase, tmp_path: Path) -> None:
    checked = checked_with(
        database, replace(parameters_for(database, battery=(0.05, 0.0)), vehicle="<Zoë & 1>"), tmp_path
    )
    (tree,) = ET.fromstring(cdfx_document(checked)).iter("SW-INSTANCE-TREE")
    assert tree.findtext("SHORT-NAME") == "<Zoë & 1>"


@pytest.mark.parametrize("name", ["a\x01.json", "a\n.json", "a\udcff.json", "<a>&.json"])
def test_a_file_of_any_name_gives_a_document_that_can_be_read(
    name: str, checked: Checked, database: VehicleDatabase
) -> None:
    layout = replace(database.layout, name="l\x02")
    other = dataclasses.replace(checked, name=name, database=dataclasses.replace(database, layout=layout))
    document = ET.fromstring(cdfx_document(other))
    shown = name.encode("unicode_escape").decode()
    assert document.findtext(".//SW-INSTANCE-TREE-ORIGIN/DATA-FILE") == shown
    assert document.findtext(".//SW-SYSTEM/SHORT-NAME") == "l\\x02"


def test_control_characters_are_refused(database: VehicleDatabase, tmp_path: Path) -> None:
    parameters = replace(parameters_for(database, battery=(0.05, 0.0)), vehicle="a\x01")
    with pytest.raises(ExportError, match=r"vehicle 'a\\x01' has .* a control character"):
        cdfx_document(checked_with(database, parameters, tmp_path))
