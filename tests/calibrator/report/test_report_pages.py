"""What stands in the pages, apart from what a browser makes of them."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from msgspec.structs import replace

from calibrator.errors import FleetError
from calibrator.estimator.results import read_run, written_of
from calibrator.report import page as page_module
from calibrator.report.traces import unity_traces
from calibrator.report.window import ideal_window, read_unity
from calibrator.report.write import ReportOptions, fleet_report, vehicle_report
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import Finding, decode_parameters
from tests.calibrator.report.results_at_hand import (
    EVIL,
    WINDOW,
    sensor,
    six_vehicle_result,
    six_vehicles,
    vehicle,
    write_result,
)

PLAIN = ReportOptions()


def facts_of(page: str) -> dict[str, object]:
    found = re.search(r'id="facts">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return dict(json.loads(found[1]))


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


def test_every_figure_is_one_that_plotly_takes(result: Path, tmp_path: Path, database: VehicleDatabase) -> None:
    earlier = six_vehicles(database)[1:]
    earlier[-1] = replace(earlier[-1], branches=earlier[0].branches)
    options = ReportOptions(earlier=write_result(tmp_path / "earlier", earlier, created="2025-06-01T00:00:00+00:00"))
    page, _ = fleet_report(result, options)
    figures = facts_of(page)["figures"]
    assert isinstance(figures, dict)
    assert set(figures) == {"verdicts", "junction", "sensors", "durations", "margin", "ageing"}
    for figure in figures.values():
        go.Figure(**figure)  # raises for names and values that plotly does not know
    assert sum(trace["x"][0] for trace in figures["verdicts"]["data"]) == 7
    assert [sum(trace["y"]) for trace in figures["junction"]["data"]] == [6, 6]


def test_names_and_reasons_are_text_and_never_code(result: Path) -> None:
    page, _ = fleet_report(result, PLAIN)
    assert EVIL not in page
    assert page.count("&lt;script&gt;document.title") == 3  # the notice, the file that was left out, and its reason


def test_the_page_fetches_nothing(result: Path) -> None:
    page, _ = fleet_report(result, PLAIN)
    assert not re.search(r'(src|href)="(?!#|data:)', page)
    assert "default-src 'none'" in page


def test_the_page_tells_the_numbers_without_its_script(result: Path) -> None:
    text = visible(fleet_report(result, PLAIN)[0])
    for told in ("6 vehicles calibrated", "2 corrected (33 %)", "1 hardware fault suspected", "10.50 A Kirchhoff sum"):
        assert told in text
    assert "V3 97.0 % −6.00 % +2.00 A −2.00 A" in text  # the workshop list


def test_the_same_result_gives_the_same_pages(result: Path) -> None:
    assert fleet_report(result, PLAIN)[0] == fleet_report(result, PLAIN)[0]
    assert vehicle_report(result, "V1")[0] == vehicle_report(result, "V1")[0]


def test_a_page_that_would_be_too_large_holds_the_evidence_of_fewer_vehicles(
    result: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, _ = fleet_report(result, PLAIN)
    assert facts_of(whole)["told"] == 6
    monkeypatch.setattr(page_module, "MOST_BYTES", len(whole) + page_module.REST_BYTES - 60_000)
    page, _ = fleet_report(result, PLAIN)
    assert facts_of(page)["told"] < 6  # type: ignore[operator]
    assert len(page) < len(whole)


def test_of_a_very_large_fleet_those_with_most_to_say_are_listed(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "MOST_LISTED", 5)
    page, report = fleet_report(result, PLAIN)
    assert facts_of(page)["vehicles"] == 5
    assert report.overview.vehicles == 6
    assert "5 of 6 vehicles are listed" in visible(page)


def test_another_method_is_laid_beside(result: Path, tmp_path: Path, database: VehicleDatabase) -> None:
    other = write_result(
        tmp_path / "other", six_vehicles(database)[:2], method="published", window=None, evidence=False
    )
    page, _ = fleet_report(result, ReportOptions(beside=other))
    assert "Beside it: method published" in visible(page)
    assert facts_of(page)["beside"] == "published"


def test_results_of_another_fleet_are_refused(result: Path, tmp_path: Path, database: VehicleDatabase) -> None:
    other = write_result(
        tmp_path / "other", [replace(item, vehicle=f"X{item.vehicle}") for item in six_vehicles(database)]
    )
    with pytest.raises(FleetError, match=r"none of its 6 vehicles is among the 6 of this result; expected another"):
        fleet_report(result, ReportOptions(earlier=other))


def test_results_that_are_neither_of_another_method_nor_of_before_are_refused(
    result: Path, tmp_path: Path, database: VehicleDatabase
) -> None:
    later = write_result(tmp_path / "later", six_vehicles(database), created="2026-02-01T00:00:00+00:00")
    with pytest.raises(FleetError, match=r"of method posterior too; expected one of another for --beside"):
        fleet_report(result, ReportOptions(beside=later))
    with pytest.raises(FleetError, match=r"made 2026-02-01.*; expected one of method posterior from before 2026-01-01"):
        fleet_report(result, ReportOptions(earlier=later))


def test_a_battery_that_there_is_not_is_refused(result: Path) -> None:
    with pytest.raises(FleetError, match="--battery rear: no such branch; expected one of battery, motor"):
        fleet_report(result, ReportOptions(battery="rear"))


@pytest.mark.parametrize(("given", "expected"), [({}, 350.0), ({"voltage_v": 800.0}, 800.0)])
def test_the_voltage_is_that_of_the_window_or_the_one_given(
    result: Path, given: dict[str, float], expected: float
) -> None:
    _, report = fleet_report(result, ReportOptions(**given))  # type: ignore[arg-type]
    assert report.protection is not None
    assert report.protection.voltage_v == expected
    assert report.protection.limit_a == 400.0


def test_a_result_of_a_method_without_evidence_has_a_page(tmp_path: Path, database: VehicleDatabase) -> None:
    result = write_result(
        tmp_path / "published", six_vehicles(database), method="published", window=None, evidence=False
    )
    page, report = fleet_report(result, PLAIN)
    assert facts_of(page)["evidence"] == []
    assert report.overview.reference == {}
    text, _ = vehicle_report(result, "V1")
    assert "No currents are drawn" in text
    assert "method published keeps none" in text


def test_the_vehicle_page_tells_its_parameters_evidence_and_currents(result: Path) -> None:
    page, report = vehicle_report(result, "V4")
    text = visible(page)
    assert "a zero-current window (contactors open) would decide" in text
    assert "60.0 % battery sensor: offset +8.00 A" in text
    assert "40.0 % motor sensor: drift -3.00%; hardware: all currents +1.00%" in text
    assert "passes through: harm limit" in text
    assert page.count("<svg") == 2
    assert "intercept battery" in page
    assert "<script" not in page
    assert report.parameters.vehicle == "V4"


def test_the_vehicle_page_lists_findings_for_the_workshop(tmp_path: Path, database: VehicleDatabase) -> None:
    vehicles = six_vehicles(database)
    findings = [
        Finding(branch="motor", cause="inverted", probability=0.993, text="motor: its sign is turned."),
        Finding(cause="load", probability=0.9, text="5 A flow where <no> sensor is."),
    ]
    vehicles[4] = replace(
        vehicles[4],
        branches={**vehicles[4].branches, "motor": sensor(0.45, 0.0, held_back="does not fit")},
        findings=findings,
    )
    result = write_result(tmp_path / "r", vehicles)
    text = visible(vehicle_report(result, "V5")[0])
    assert "For the workshop" in text
    assert "motor inverted 99.3 % motor: its sign is turned." in text
    assert "vehicle load 90.0 % 5 A flow where <no> sensor is." in text
    assert "passes through: does not fit" in text
    assert "does not fit" in visible(fleet_report(result, PLAIN)[0])
    assert "For the workshop" not in visible(vehicle_report(result, "V1")[0])


def test_without_deviations_no_margin_is_told(tmp_path: Path, database: VehicleDatabase) -> None:
    unsure = replace(sensor(0.1, 4.0, apply=True), drift_sd=None, offset_sd_a=None)
    page, report = fleet_report(write_result(tmp_path / "r", [vehicle(database, "V1", unsure, sensor())]), PLAIN)
    assert report.protection is None
    assert "does not say how sure its estimates are" in visible(page)


def test_many_branches_are_listed_as_far_as_there_is_room(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, _ = fleet_report(result, PLAIN)
    size = len(re.search(r'id="columns">(.*?)</script>', whole, re.DOTALL)[1])  # type: ignore[index]
    monkeypatch.setattr(page_module, "LISTED_SHARE", 0.9 * size / (page_module.MOST_BYTES - len(whole)))
    page, _ = fleet_report(result, PLAIN)
    assert 0 < facts_of(page)["vehicles"] < 6  # type: ignore[operator]


def test_a_result_of_an_older_version_is_told_to_be_one(result: Path) -> None:
    text = (result / "run.json").read_text()
    (result / "run.json").write_text(text.replace('"full_scale_a": 400.0', '"full_scale_a": 0.0'))
    with pytest.raises(FleetError, match="no full_scale_a, it is of an older version; calibrate again"):
        fleet_report(result, PLAIN)


def test_a_vehicle_that_was_left_out_is_told_why(result: Path) -> None:
    with pytest.raises(FleetError, match="it was left out: cannot be read"):
        vehicle_report(result, f"log of {EVIL}")
    with pytest.raises(FleetError, match="no vehicle 'V99' in it"):
        vehicle_report(result, "V99")


def test_a_damaged_window_is_named(result: Path) -> None:
    (result / "unity.parquet").write_bytes(WINDOW.encoded()[:-100])
    with pytest.raises(FleetError, match=r"unity\.parquet: damaged unity window"):
        fleet_report(result, PLAIN)


def test_a_result_without_parameters_is_named(tmp_path: Path, database: VehicleDatabase) -> None:
    result = six_vehicle_result(tmp_path / "r", database)
    for path in (result / "parameters").iterdir():
        path.unlink()
    with pytest.raises(FleetError, match="no parameters there; give the whole folder"):
        fleet_report(result, PLAIN)


def test_the_window_of_a_sure_vehicle_sums_to_what_its_offsets_leave(result: Path) -> None:
    run, written = read_run(result), written_of(result, "V10")
    window = ideal_window(read_unity(result), run)
    assert window is not None
    assert written.evidence is not None
    traces = unity_traces(decode_parameters(written.text, "V10"), written.evidence, run.details["evidence"], window)
    np.testing.assert_allclose(traces.corrected_a, window.ideal_a, atol=1e-4)
    np.testing.assert_allclose(traces.corrected_a.sum(axis=1), 0.0, atol=1e-4)
    np.testing.assert_allclose(traces.measured_a[:, 1], window.ideal_a[:, 1] - 6.0, atol=1e-4)
