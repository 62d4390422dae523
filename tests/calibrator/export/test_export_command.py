"""``calibrator export``: one file, written whole or not at all, and what is refused with one line."""

import dataclasses
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from calibrator.errors import ExportError
from calibrator.export.core import Checked
from calibrator.export.tool_formats import cdfx_text, dcm_text
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import BranchParameters, write_parameters
from tests.calibrator.export.exports import checked_with, export, refused
from tests.ecu_node.vehicles import SMALL_LAYOUT, MakeDatabase, parameters_for


@pytest.fixture
def params(database: VehicleDatabase, tmp_path: Path) -> Path:
    """The parameter file of a vehicle."""
    path = tmp_path / "v1.json"
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), path)
    return path


@pytest.mark.parametrize("form", ["c", "dcm", "cdfx"])
def test_export_replaces_a_different_file_only_with_replace(form: str, params: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / f"v1.{form}"
    arguments = (params, "--format", form, "--output", out)
    for _ in range(2):  # the same again is no error
        run = export(*arguments)
        assert (run.returncode, run.stderr, run.stdout) == (0, "", f"{out}\n")
    content = out.read_bytes()
    out.write_text("mine")
    assert "exists; choose another --out, or replace it with --replace" in refused(*arguments)
    assert out.read_text() == "mine"
    assert export(*arguments, "--replace").returncode == 0
    assert (out.read_bytes(), len(list(out.parent.iterdir()))) == (content, 1)


def test_export_refuses_other_vehicles_and_layouts(params: Path, tmp_path: Path, make_database: MakeDatabase) -> None:
    more = ("--format", "c", "--output", tmp_path / "out")
    assert "v1.json: parameters are for vehicle 'v1', this is 'v7'" in refused(params, *more, "--vehicle", "v7")
    said = refused(params, *more, layout=make_database().layout.path)
    assert re.search(r"made with layout hv_powertrain\.toml .*, this is .*small", said)
    assert not (tmp_path / "out").exists()


def test_export_to_c_gives_a_notice_of_e2e_profiles_that_it_lacks(make_database: MakeDatabase, tmp_path: Path) -> None:
    layout = SMALL_LAYOUT + '\n[e2e]\nprofile = "P05"\noffset = 4\nmessages = ["Pair"]\n'
    database = make_database(layout)
    write_parameters(parameters_for(database, battery=(0.05, 2.3)), tmp_path / "v1.json")
    run = export(tmp_path / "v1.json", "--format", "c", "--output", tmp_path / "v1.c", layout=database.layout.path)
    assert run.stderr.startswith("notice: the C core knows the E2E profiles P01 and P02: check Pair before hv_forward")


# DCM and CDFX as readers find them: values, units, provenance, and texts that a format cannot hold

ORDER = {
    "MSRSW": ["SHORT-NAME", "CATEGORY", "SW-SYSTEMS"],
    "SW-SYSTEMS": ["SW-SYSTEM"],
    "SW-SYSTEM": ["SHORT-NAME", "SW-INSTANCE-SPEC"],
    "SW-INSTANCE-SPEC": ["SW-INSTANCE-TREE"],
    "SW-INSTANCE-TREE": ["SHORT-NAME", "CATEGORY", "SW-INSTANCE-TREE-ORIGIN", "SW-CS-COLLECTIONS", "SW-INSTANCE"],
    "SW-INSTANCE-TREE-ORIGIN": ["SYMBOLIC-FILE", "DATA-FILE"],
    "SW-CS-COLLECTIONS": ["SW-CS-COLLECTION"],
    "SW-CS-COLLECTION": ["CATEGORY", "SW-FEATURE-REF", "REVISION"],
    "SW-INSTANCE": ["SHORT-NAME", "LONG-NAME", "CATEGORY", "SW-FEATURE-REF", "SW-VALUE-CONT", "SW-CS-HISTORY"],
    "SW-VALUE-CONT": ["UNIT-DISPLAY-NAME", "SW-VALUES-PHYS"],
    "SW-VALUES-PHYS": ["VT", "V"],
    "SW-CS-HISTORY": ["CS-ENTRY"],
    "CS-ENTRY": ["STATE", "DATE", "CSUS", "CSPR", "CSWP", "CSTO", "CSPI", "CSDI", "REMARK"],
    "REMARK": ["P"],
}
"""Children of each element that the export writes, in the order of ASAM's DTD ``cdf_v2.0.0.sl.dtd``."""
FAULT = {"drift": 0.05, "offset": -1.23456789012345}
BATTERY = {"gain": 1 / 1.05, "applied": 1, **FAULT, **{f"found.{name}": value for name, value in FAULT.items()}}
MOTOR = {"gain": 1.0, "bias": 0.0, "fraction": 0.5, "applied": 0, "drift": 0.0, "offset": 0.0}
MOTOR |= {"found.drift": 0.2, "found.drift_sd": 0.01, "found.offset": 7.0}
BRANCHES = {"battery": BATTERY, "motor": MOTOR, "motor_rear": {"applied": 0, "drift": 0.0}}
VALUES = {f"HV.{branch}.{name}": value for branch, values in BRANCHES.items() for name, value in values.items()}
VALUES["HV.parameter_set"] = 300.0


@pytest.fixture
def checked(database: VehicleDatabase, tmp_path: Path) -> Checked:
    """The battery is corrected, the motor held back, of the others nothing is known."""
    parameters = parameters_for(database, battery=(0.05, -1.23456789012345))
    motor = BranchParameters(drift=0.2, offset_a=7.0, drift_sd=0.01, apply=False, held_back="harm limit")
    return checked_with(database, replace(parameters, branches={**parameters.branches, "motor": motor}), tmp_path)


def renamed(checked: Checked, vehicle: str) -> Checked:
    return dataclasses.replace(checked, parameters=replace(checked.parameters, vehicle=vehicle))


def test_cdfx_follows_the_order_of_the_dtd_and_holds_the_values_of_the_parameters(checked: Checked) -> None:
    document = ET.fromstring(cdfx_text(checked))
    for element in document.iter():
        tags, order = [child.tag for child in element], ORDER.get(element.tag, [])
        assert tags == sorted(tags, key=order.index), element.tag
        once = [tag for tag in tags if tag not in {"SW-INSTANCE", "SW-CS-COLLECTION"}]
        assert len(once) == len(set(once)), element.tag
    (tree,) = document.iter("SW-INSTANCE-TREE")
    assert [tree.findtext(tag) for tag in ("SHORT-NAME", "CATEGORY", "*/DATA-FILE")] == ["v1", "NO_VCD", "v1.json"]
    instances = {item.findtext("SHORT-NAME", ""): item for item in document.iter("SW-INSTANCE")}
    words = {"true": "1", "false": "0"}
    texts = {name: (instances[name].findtext(".//V"), instances[name].findtext(".//VT", "")) for name in VALUES}
    found = {name: float(number or words[word]) for name, (number, word) in texts.items()}
    assert found == pytest.approx(VALUES, abs=1e-12)
    assert instances["HV.battery.offset"].findtext(".//UNIT-DISPLAY-NAME") == "A"
    declared = {item.findtext("SW-FEATURE-REF") for item in document.iter("SW-CS-COLLECTION")}
    for item in instances.values():
        entry = [item.findtext(f".//CS-ENTRY/{tag}") for tag in ("DATE", "CSUS", "CSTO", "CSDI")]
        assert entry == ["2026-01-01T00:00:00Z", "test", "v1", f"300 {checked.digest}"]
        assert item.findtext("SW-FEATURE-REF") in declared


def test_dcm_and_cdfx_hold_the_provenance(checked: Checked) -> None:
    checked = dataclasses.replace(renamed(checked, "<Zoë & 1>"), name="<a>&\udcff.json")
    wanted = {key: value for key, value in checked.provenance.items() if key != "parameter_set"}
    form = r'^TEXTSTRING HV\.(\w+)\n  LANGNAME "[^"\n]*"\n  FUNKTION \w+\n  TEXT "([^"\n]*)"\nEND$'
    assert dict(re.findall(form, dcm_text(checked), flags=re.MULTILINE)) == wanted
    document = ET.fromstring(cdfx_text(checked))
    texts = {item.findtext("LONG-NAME"): item.findtext(".//VT") for item in document.iter("SW-INSTANCE")}
    assert wanted.items() <= texts.items()
    assert document.findtext(".//DATA-FILE") == "<a>&\\udcff.json"


@pytest.mark.parametrize("write", [dcm_text, cdfx_text])
@pytest.mark.parametrize("vehicle", ['a "b"', "a\\b", "a\nb"])
def test_vehicle_name_with_quotation_mark_or_control_character_is_refused(
    write: Callable[[Checked], object], vehicle: str, checked: Checked
) -> None:
    with pytest.raises(ExportError, match=r"^v1\.json: vehicle '.*' has a quotation mark, a backslash or a control"):
        write(renamed(checked, vehicle))
