"""Contents of the report pages, without a browser."""

import base64
import gzip
import html
import json
import re
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from calibrator.errors import FleetError
from calibrator.report import page as page_module
from calibrator.report.overview import share
from calibrator.report.page import report_page
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import SensorFinding
from tests.calibrator.command_here import reported, succeeded
from tests.calibrator.report.results_at_hand import EVIL, sensor, six_vehicles, write_result

NO_HARDWARE = {"hardware_drift": 0.0, "hardware_offset_a": {}}


def packed(page: str, name: str) -> Any:
    """Data of the page that a browser unpacks."""
    (found,) = re.findall(f'id="{name}-data">(.*?)</script>', page, re.DOTALL)
    return json.loads(gzip.decompress(base64.b64decode(found)))


def visible(page: str) -> str:
    """Text of a page outside scripts and styles, blanks together."""
    shown = re.sub(r"<(script|style)\b.*?</\1>|<[^>]*>", " ", page, flags=re.DOTALL)
    return " ".join(html.unescape(shown).split())


def test_page_escapes_names_and_reasons_and_refers_to_no_external_resource(result: Path) -> None:
    page, _ = report_page(result)
    assert EVIL not in page
    assert page.count("&lt;script&gt;document.title") == 5  # the notice, what was left out, why, and both in the step
    assert not re.search(r'(src|href)="(?!#|data:)', page)
    assert "default-src 'none'" in page


def test_report_page_shows_its_numbers_without_javascript(result: Path) -> None:
    text = visible(report_page(result)[0])
    for part in ("7 vehicles looked at", "2 corrected (33 %)", "2 for the workshop", "10.50 A Kirchhoff sum"):
        assert part in text
    assert "V3 the vehicle hardware 97.0 % its currents differ from the fleet's: all −6.00 %, battery +2.00 A" in text
    assert "1 because it is beyond the limits of the layout" in text


def test_page_of_a_very_large_fleet_lists_only_part_and_says_so(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "MOST_SENSORS", 11)
    page, report = report_page(result)
    assert len(packed(page, "columns")["vehicle"]) == 5
    assert report["overview"]["vehicles"] == 6
    assert "5 of 6 vehicles are listed" in visible(page)


def test_page_of_a_vehicle_is_about_this_vehicle_alone(result: Path) -> None:
    page, about = report_page(result, "V4")
    text = visible(page)
    assert about["parameters"].vehicle == "V4"
    assert text.count("Vehicle V4") == 1
    assert "One of the 6 vehicles of at hand" in text
    assert "cannot tell verdict; confidence of the estimate 97.0 %" in text
    assert "8.00 A Kirchhoff sum on the bus, as nothing is corrected" in text
    assert "V4: a zero-current window (contactors open) would decide." in text
    assert "V1" not in text
    (facts,) = re.findall(r'id="facts">(.*?)</script>', page, re.DOTALL)
    assert json.loads(facts)["alone"]
    (own,) = packed(page, "details")
    first, second = own["explanations"]
    assert first == {"probability": 0.6, "drift": {}, "offset_a": {"battery": 8.0}, **NO_HARDWARE}
    wanted = {"probability": 0.4, "drift": {"motor": -0.03}, "offset_a": {}}
    assert second == {**wanted, **NO_HARDWARE, "hardware_drift": 0.01}


def test_findings_appear_in_the_workshop_list_and_with_the_vehicle(tmp_path: Path, database: VehicleDatabase) -> None:
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
    for page in (report_page(result, "V5")[0], report_page(result)[0]):
        text = visible(page)
        assert "V5 motor inverted 99.3 % motor: its sign is turned." in text
        assert "V5 the vehicle load 90.0 % 5 A flow where <no> sensor is." in text
        found = [each for row in packed(page, "details") for each in row["findings"]]
        assert ("motor", "inverted", 0.993) in [(each["branch"], each["cause"], each["probability"]) for each in found]
    assert "Workshop list" not in visible(report_page(result, "V1")[0])


def test_report_of_a_left_out_or_unknown_vehicle_is_refused_with_the_reason(result: Path) -> None:
    with pytest.raises(FleetError, match="it was left out: cannot be read"):
        report_page(result, f"log of {EVIL}")
    with pytest.raises(FleetError, match="no vehicle 'V99' in it"):
        report_page(result, "V99")


@pytest.mark.parametrize(
    ("part", "whole", "text"),
    [(0, 9, "0 %"), (1, 3000, "< 1 %"), (1, 3, "33 %"), (2999, 3000, "> 99 %"), (9, 9, "100 %")],
)
def test_share_of_some_vehicles_is_never_rounded_to_0_or_100_percent(part: int, whole: int, text: str) -> None:
    assert share(part, whole) == text


def test_report_command_writes_the_page_and_prints_its_numbers(result: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "page.html"
    said = succeeded("report", result, "--out", out)
    assert said == f"{out}: {out.stat().st_size / 1e6:.2f} MB; open it in a browser\n"
    found = reported("report", result, "--out", out, "--limit", 300)
    assert found["bytes"] == out.stat().st_size
    assert found["overview"]["verdicts"] == {"corrected": 2, "no sensor fault": 2, "cannot tell": 2}
    assert found["protection"]["limit_a"] == 300.0
    assert len(found["next_steps"]) == 5
    assert found["workshop"][0]["cause"] == "hardware"
