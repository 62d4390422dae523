"""What stands in the pages, apart from what a browser makes of them."""

import base64
import gzip
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pyarrow.parquet as pq
import pytest
from msgspec.structs import replace

from calibrator.errors import FleetError
from calibrator.report import page as page_module
from calibrator.report.page import fleet_report, vehicle_report
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import HardwareFault, SensorFinding
from tests.calibrator.report.results_at_hand import (
    EVIL,
    sensor,
    six_vehicle_result,
    six_vehicles,
    vehicle,
    write_result,
)

NO_HARDWARE = {"hardware_drift": 0.0, "hardware_offset_a": {}}


def facts_of(page: str) -> dict[str, Any]:
    found = re.search(r'id="facts">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return dict(json.loads(found[1]))


def packed(page: str, name: str) -> bytes:
    """What a browser unpacks."""
    found = re.search(f'id="{name}-data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return gzip.decompress(base64.b64decode(found[1]))


def columns_of(page: str) -> dict[str, np.ndarray[Any, Any]]:
    """Columns of the vehicles that are listed, by name; NaN where not known."""
    return {
        name: np.array([np.nan if each is None else each for each in values])
        for name, values in json.loads(packed(page, "columns")).items()
    }


def visible(page: str) -> str:
    """Text of a page outside scripts and styles, blanks together."""

    class Reader(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.parts: list[str] = []
            self.hidden = 0

        def handle_starttag(self, tag: str, attrs: object) -> None:
            self.hidden += tag in {"script", "style"}

        def handle_endtag(self, tag: str) -> None:
            self.hidden -= tag in {"script", "style"}

        def handle_data(self, data: str) -> None:
            if not self.hidden:
                self.parts.append(data)

    reader = Reader()
    reader.feed(page)
    return " ".join(" ".join(reader.parts).split())


def test_every_figure_is_one_that_plotly_takes(result: Path) -> None:
    figures = facts_of(fleet_report(result)[0])["figures"]
    assert set(figures) == {"junction", "sensors"}
    for figure in figures.values():
        go.Figure(**figure)  # raises for names and values that plotly does not know
    before, after, load = figures["junction"]["data"]
    assert (sum(before["y"]), sum(after["y"])) == (6, 6)
    assert load["x"] == [0.3, 0.3]


def test_other_explanations_of_an_undecided_sensor_are_drawn(result: Path) -> None:
    traces = facts_of(fleet_report(result)[0])["figures"]["sensors"]["data"]
    battery = {trace["name"]: trace for trace in traces if trace["xaxis"] == "x"}
    assert battery["not corrected"]["y"] == [8.0]
    assert battery["what it may be instead"]["y"] == [0.0]
    assert battery["what it may be instead"]["text"] == ["V4, 40%"]


def test_columns_of_vehicles_are_those_of_the_result(result: Path) -> None:
    stored = pq.read_table(result / "results.parquet").to_pylist()
    page = fleet_report(result)[0]
    found = columns_of(page)
    names = found["vehicle"].tolist()
    assert set(names) == {"V1", "V2", "V3", "V4", "V5", "V10"}
    for row in stored:
        if row["branch"] is not None:
            j = names.index(row["vehicle"])
            i = 2 * j + ("battery", "motor").index(row["branch"])
            assert found["drift"][i] == pytest.approx(row["drift"], abs=5.1e-6)
            assert found["offset_sd_a"][i] == pytest.approx(row["offset_sd_a"], abs=5.1e-3)
            assert found["applied"][i] == row["applied"]
            assert found["junction_rms_measured_a"][j] == pytest.approx(row["junction_rms_measured_a"], abs=5.1e-3)


def test_values_that_are_not_known_stay_so(tmp_path: Path, database: VehicleDatabase) -> None:
    still = replace(sensor(), identifiable=False, fault_probability=None)
    lost = replace(sensor(), drift_sd=None, offset_sd_a=None)
    open_ones = replace(sensor(), offset_sd_a=200.0)
    items = [vehicle(database, "V1", sensor(), still), vehicle(database, "V2", lost, open_ones)]
    found = columns_of(fleet_report(write_result(tmp_path / "r", items))[0])
    assert found["unknown"].tolist() == [0.0, 1.0, 3.0, 2.0]
    assert np.isnan(found["fault_probability"][1])
    assert np.isnan(found["drift_sd"][2])


def test_names_and_reasons_are_text_and_never_code(result: Path) -> None:
    page, _ = fleet_report(result)
    assert EVIL not in page
    assert page.count("&lt;script&gt;document.title") == 5  # the notice, what was left out, why, and both in the step


def test_the_page_fetches_nothing(result: Path) -> None:
    page, _ = fleet_report(result)
    assert not re.search(r'(src|href)="(?!#|data:)', page)
    assert "default-src 'none'" in page


def test_the_page_has_its_numbers_without_its_script(result: Path) -> None:
    text = visible(fleet_report(result)[0])
    for part in ("7 vehicles looked at", "2 corrected (33 %)", "2 for the workshop", "10.50 A Kirchhoff sum"):
        assert part in text
    assert "V3 the vehicle hardware 97.0 % its currents differ from the fleet's: all −6.00 %, battery +2.00 A" in text
    assert "1 because it is beyond the limits of the layout" in text


def test_the_same_result_gives_the_same_pages(result: Path) -> None:
    assert fleet_report(result)[0] == fleet_report(result)[0]
    assert vehicle_report(result, "V1")[0] == vehicle_report(result, "V1")[0]


def test_large_page_holds_the_evidence_of_the_first_vehicles(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(json.loads(packed(fleet_report(result)[0], "details"))) == 6
    monkeypatch.setattr(page_module, "MOST_DETAILED", 4)
    assert len(json.loads(packed(fleet_report(result)[0], "details"))) == 4


def test_of_a_very_large_fleet_those_with_a_fault_are_listed(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "MOST_SENSORS", 11)
    page, report = fleet_report(result)
    assert len(columns_of(page)["vehicle"]) == 5
    assert report["overview"]["vehicles"] == 6
    assert "5 of 6 vehicles are listed" in visible(page)


def test_a_battery_that_there_is_not_is_refused(result: Path) -> None:
    with pytest.raises(FleetError, match="--battery rear: no such branch; expected one of battery, motor"):
        fleet_report(result, battery="rear")


def test_a_result_of_a_method_without_evidence_has_a_page(tmp_path: Path, database: VehicleDatabase) -> None:
    result = write_result(tmp_path / "published", six_vehicles(database), method="published", evidence=False)
    page, report = fleet_report(result)
    assert facts_of(page)["evidence"] == []
    assert report["overview"]["reference"] == {}


def test_the_page_of_a_vehicle_is_about_this_vehicle_alone(result: Path) -> None:
    page, parameters = vehicle_report(result, "V4")
    text = visible(page)
    assert parameters.vehicle == "V4"
    assert text.count("Vehicle V4") == 1
    assert "One of the 6 vehicles of at hand" in text
    assert "cannot tell verdict; confidence of the estimate 97.0 %" in text
    assert "8.00 A Kirchhoff sum on the bus, as nothing is corrected" in text
    assert "V4: a zero-current window (contactors open) would decide." in text
    assert "V1" not in text
    facts = facts_of(page)
    assert (facts["alone"], facts["figures"]) == (True, {})
    (own,) = json.loads(packed(page, "details"))
    first, second = own["explanations"]
    assert first == {"probability": 0.6, "drift": {}, "offset_a": {"battery": 8.0}, **NO_HARDWARE}
    assert second == {
        "probability": 0.4,
        "drift": {"motor": -0.03},
        "offset_a": {},
        **NO_HARDWARE,
        "hardware_drift": 0.01,
    }


def test_a_result_of_one_vehicle_has_no_fleet(tmp_path: Path, database: VehicleDatabase) -> None:
    """As one junction calibrated by itself gives it: no reference, no evidence, no hardware probability."""
    item = replace(
        vehicle(database, "car", sensor(0.1, 4.0, apply=True), replace(sensor(), identifiable=False)),
        hardware_fault=HardwareFault(suspected=False),
    )
    page, report = fleet_report(write_result(tmp_path / "r", [item], evidence=False))
    text = visible(page)
    assert "Vehicle car" in text
    assert "not known hardware fault: only a comparison with a fleet shows one" in text
    assert "of the fleet" not in text
    assert "45.2 A margin as measured" in text
    assert report["protection"] is not None
    assert facts_of(page)["figures"] == {}
    assert columns_of(page)["unknown"].tolist() == [0.0, 1.0]


def test_a_result_without_a_vehicle_is_refused(tmp_path: Path) -> None:
    result = write_result(tmp_path / "r", [], left_out={"V1": "its drive is too short"})
    with pytest.raises(FleetError, match="no vehicle in it has parameters; V1: its drive is too short"):
        fleet_report(result)


def test_findings_are_in_the_workshop_list_and_with_the_vehicle(tmp_path: Path, database: VehicleDatabase) -> None:
    vehicles = six_vehicles(database)
    findings = [
        SensorFinding(branch="motor", cause="inverted", probability=0.993, text="motor: its sign is turned."),
        SensorFinding(cause="load", probability=0.9, text="5 A flow where <no> sensor is."),
    ]
    vehicles[4] = replace(
        vehicles[4],
        branches={**vehicles[4].branches, "motor": sensor(0.45, 0.0, held_back="does not fit")},
        findings=findings,
    )
    result = write_result(tmp_path / "r", vehicles)
    for page in (vehicle_report(result, "V5")[0], fleet_report(result)[0]):
        text = visible(page)
        assert "V5 motor inverted 99.3 % motor: its sign is turned." in text
        assert "V5 the vehicle load 90.0 % 5 A flow where <no> sensor is." in text
        found = [each for row in json.loads(packed(page, "details")) for each in row["findings"]]
        assert ("motor", "inverted", 0.993) in [(each["branch"], each["cause"], each["probability"]) for each in found]
    assert "Workshop list" not in visible(vehicle_report(result, "V1")[0])


def test_without_deviations_no_margin_is_given(tmp_path: Path, database: VehicleDatabase) -> None:
    unsure = replace(sensor(0.1, 4.0, apply=True), drift_sd=None, offset_sd_a=None)
    page, report = fleet_report(write_result(tmp_path / "r", [vehicle(database, "V1", unsure, sensor())]))
    assert report["protection"] is None
    assert "How wrong the battery sensor can be is not known" in visible(page)


def test_a_result_of_an_older_version_is_told_to_be_one(result: Path) -> None:
    text = (result / "run.json").read_text()
    (result / "run.json").write_text(text.replace('"full_scale_a": 400.0', '"full_scale_a": 0.0'))
    with pytest.raises(FleetError, match="no full_scale_a, it is of an older version; calibrate again"):
        fleet_report(result)


def test_a_vehicle_that_was_left_out_is_told_why(result: Path) -> None:
    with pytest.raises(FleetError, match="it was left out: cannot be read"):
        vehicle_report(result, f"log of {EVIL}")
    with pytest.raises(FleetError, match="no vehicle 'V99' in it"):
        vehicle_report(result, "V99")


def test_a_result_without_parameters_is_named(tmp_path: Path, database: VehicleDatabase) -> None:
    result = six_vehicle_result(tmp_path / "r", database)
    for path in (result / "parameters").iterdir():
        path.unlink()
    with pytest.raises(FleetError, match=r"no parameters of vehicle V\d+ there; give the whole folder"):
        fleet_report(result)
