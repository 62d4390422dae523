"""The report as a user sees it: opened in Chromium from the disk."""

import base64
import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from msgspec.structs import replace
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select
from selenium.webdriver.support.wait import WebDriverWait

from calibrator.report.page import report_page
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import Explanation
from tests.calibrator.report.results_at_hand import sensor, six_vehicle_result, six_vehicles, vehicle, write_result

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, database: VehicleDatabase) -> Path:
    return six_vehicle_result(tmp_path_factory.mktemp("report") / "result", database)


@pytest.fixture
def page(browser: webdriver.Chrome, result: Path, tmp_path: Path) -> webdriver.Chrome:
    """The report of the fleet, opened and set up."""
    return opened(browser, report_page(result)[0], tmp_path / "report.html")


def opened(browser: webdriver.Chrome, text: str, path: Path) -> webdriver.Chrome:
    """Open a page and discard earlier logs of the browser."""
    path.write_text(text)
    browser.get_log("browser")
    browser.get_log("performance")
    browser.get(f"file://{path}")
    until(browser, "return document.body.dataset.ready || document.body.dataset.failed")
    return browser


def until(browser: webdriver.Chrome, script: str) -> Any:
    return WebDriverWait(browser, PATIENCE_S).until(lambda it: it.execute_script(script))


def drawn(browser: webdriver.Chrome, count: int, where: str = "#vehicle") -> None:
    """Wait until so many figures are drawn."""
    until(browser, f"return document.querySelectorAll('{where} .plot[data-drawn]').length === {count}")


def find(browser: webdriver.Chrome, *keys: str, shown: str) -> None:
    """Type into the field that searches for names, and wait for the count of vehicles that are shown."""
    browser.find_element(By.ID, "find").send_keys(*keys)
    until(browser, f"return document.getElementById('count').textContent.startsWith('{shown}')")


def rows(browser: webdriver.Chrome) -> list[list[str]]:
    found: list[list[str]] = browser.execute_script(
        "return [...document.querySelectorAll('#table tbody tr')]"
        ".map((row) => [...row.cells].map((cell) => cell.textContent))"
    )
    return found


def vehicle_text(browser: webdriver.Chrome, name: str) -> str:
    """Choose a vehicle; returns what the page shows of it."""
    browser.execute_script(f"location.hash = 'vehicle={name}'")
    until(browser, f"return document.getElementById('vehicle').dataset.vehicle === '{name}'")
    return browser.find_element(By.ID, "vehicle").text


def names(browser: webdriver.Chrome) -> list[str]:
    return [row[0] for row in rows(browser)]


def test_report_opens_without_an_error_and_loads_nothing_from_the_network(page: webdriver.Chrome) -> None:
    drawn(page, 2, "body")
    assert page.execute_script("return document.body.dataset.failed") is None
    assert page.get_log("browser") == []
    events = [json.loads(entry["message"])["message"] for entry in page.get_log("performance")]
    asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
    assert [url for url in asked if not url.startswith(("file://", "data:", "blob:"))] == []
    assert sum(url.startswith("file://") for url in asked) <= 1
    assert "run" not in page.title


def test_table_of_vehicles_shows_the_numbers_of_the_result(page: webdriver.Chrome, result: Path) -> None:
    stored = [row for row in pq.read_table(result / "results.parquet").to_pylist() if row["branch"] == "battery"]
    shown = {row[0]: row for row in rows(page)}
    assert set(shown) == {row["vehicle"] for row in stored}
    for row in stored:
        cells = shown[row["vehicle"]]
        assert cells[1] == row["verdict"]
        assert cells[2] == f"{100 * row['confidence']:.1f} %"
        assert cells[3] == f"{row['junction_rms_measured_a']:.2f} A"
        assert cells[4] == f"{row['junction_rms_corrected_a']:.2f} A"
        assert cells[7] == f"{100 * row['hardware_probability']:.1f} %"
        assert cells[8] == "30.0 min"


def test_both_explanations_of_an_ambiguous_offset_are_shown_with_their_probabilities(page: webdriver.Chrome) -> None:
    text = vehicle_text(page, "V4")
    assert "battery 0.00 ± 2.00 +8.00 ± 2.00 (60 %) or none (40 %)" in text
    assert "60.0 % +8.00 A no fault no fault" in text
    assert "40.0 % no fault −3.00 % all currents +1.00 %" in text
    assert "a zero-current window (contactors open) would decide" in text.lower()
    assert "does not correct it: the correction might do harm" in text
    drawn(page, 2)
    peaks = page.execute_script(
        "const [, offsets] = document.querySelector('#vehicle .plot').data;"
        "return offsets.x.map((x, n) => [offsets.y[n], x, offsets.marker.size[n]])"
        ".filter(([name]) => name === 'battery')"
    )
    assert [peak[1] for peak in peaks] == [8.0, 0.0]
    assert peaks[0][2] > peaks[1][2], "the more probable, the larger"


def test_competing_explanations_are_drawn_in_the_figure_of_sensors(
    browser: webdriver.Chrome, database: VehicleDatabase, tmp_path: Path
) -> None:
    vehicles = six_vehicles(database)
    rivals = [vehicles[3].explanations[0], Explanation(probability=0.4, offset_a={"battery": -12.0})]
    vehicles[3] = replace(vehicles[3], explanations=rivals)
    opened(browser, report_page(write_result(tmp_path / "r", vehicles))[0], tmp_path / "page.html")
    until(browser, "return document.querySelector('#sensors-figure[data-drawn]')")
    data, layout = browser.execute_script(
        "const { data, layout } = document.getElementById('sensors-figure'); return [data, layout]"
    )
    battery = {trace["name"]: trace for trace in data if trace["xaxis"] == "x"}
    assert battery["not corrected"]["y"] == [8.0]
    assert battery["not corrected"]["error_y"]["array"] == [2.0]
    assert battery["what it may be instead"]["y"] == [-12.0]
    assert battery["what it may be instead"]["text"] == ["V4, 40 %"]
    assert layout["yaxis"]["range"] == pytest.approx([-13.2, 13.2])


def test_undetermined_values_are_shown_as_not_known_instead_of_zero(
    browser: webdriver.Chrome, database: VehicleDatabase, tmp_path: Path
) -> None:
    lost = replace(sensor(), drift_sd=None, offset_sd_a=None, fault_probability=None, delay_s=None)
    items = [
        vehicle(database, "V1", lost, lost, verdict="cannot tell"),
        vehicle(database, "V2", sensor(), replace(sensor(), identifiable=False)),
    ]
    opened(browser, report_page(write_result(tmp_path / "r", items))[0], tmp_path / "page.html")
    assert {row[0]: row[5] for row in rows(browser)} == {"V1": "not known", "V2": "not known"}
    text = vehicle_text(browser, "V1")
    assert "battery not known not known not known not known does not correct it: not known well enough" in text
    assert "motor not known 0.00 ± 0.10" in vehicle_text(browser, "V2")


def test_filters_show_only_matching_vehicles(page: webdriver.Chrome) -> None:
    find(page, "v1", shown="2 of 6")
    assert sorted(names(page)) == ["V1", "V10"]
    find(page, Keys.BACKSPACE, Keys.BACKSPACE, shown="6 of 6")
    verdict = Select(page.find_element(By.ID, "verdict"))
    verdict.select_by_value("cannot tell")
    assert sorted(names(page)) == ["V4", "V5"]
    verdict.select_by_value("")
    page.find_element(By.ID, "suspected").click()
    assert names(page) == ["V3"]
    page.find_element(By.ID, "suspected").click()
    page.find_element(By.ID, "only-corrected").click()
    assert sorted(names(page)) == ["V1", "V10"]


def test_column_headings_sort_the_table_and_set_aria_sort(page: webdriver.Chrome) -> None:
    heads = {head.text: head for head in page.find_elements(By.CSS_SELECTOR, "#table th button")}
    heads["vehicle"].click()
    assert names(page) == ["V1", "V2", "V3", "V4", "V5", "V10"], "numbers in names count as numbers"
    heads["vehicle"].click()
    assert names(page) == ["V10", "V5", "V4", "V3", "V2", "V1"]
    heads["sum before"].click()
    assert names(page)[:2] == ["V5", "V1"]
    assert heads["sum before"].find_element(By.XPATH, "..").get_attribute("aria-sort") == "descending"
    assert heads["vehicle"].find_element(By.XPATH, "..").get_attribute("aria-sort") is None


def test_vehicle_can_be_chosen_with_the_keyboard(page: webdriver.Chrome) -> None:
    find(page, "V10", shown="1 of 6")
    focused = page.switch_to.active_element
    for _ in range(40):
        focused.send_keys(Keys.TAB)
        focused = page.switch_to.active_element
        if focused.text == "V10":
            break
    assert focused.text == "V10"
    focused.send_keys(Keys.ENTER)
    until(page, "return document.getElementById('vehicle').dataset.vehicle === 'V10'")
    assert page.switch_to.active_element.get_attribute("id") == "vehicle"


def test_heading_levels_are_in_order_and_controls_have_names(page: webdriver.Chrome) -> None:
    levels = [int(head.tag_name[1]) for head in page.find_elements(By.CSS_SELECTOR, "h1, h2, h3, h4")]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    controls = page.find_elements(By.CSS_SELECTOR, "input, select, button")
    assert [control.get_attribute("id") for control in controls if not control.accessible_name] == []
    assert page.execute_script("return document.documentElement.lang") == "en"
    assert "at hand" in page.title


def test_report_of_a_single_vehicle_without_stored_evidence_opens_without_errors(
    browser: webdriver.Chrome, database: VehicleDatabase, tmp_path: Path
) -> None:
    rivals = [Explanation(probability=0.6), Explanation(probability=0.4, offset_a={"motor": 2.2})]
    mixed = replace(sensor(0.0, 0.9, sd=0.011), identifiable=False)
    item = vehicle(database, "car", sensor(0.1, 4.0, apply=True), mixed, explanations=rivals)
    item = replace(item, hardware_fault=replace(item.hardware_fault, probability=None))
    result = write_result(tmp_path / "r", [item], evidence=False)
    opened(browser, report_page(result)[0], tmp_path / "car.html")
    assert browser.get_log("browser") == []
    assert browser.execute_script("return document.body.dataset.failed") is None
    text = browser.find_element(By.TAG_NAME, "main").text
    assert "battery +10.00 ± 0.10 +4.00 ± 0.10 99.5 % 0.02 % 20 ms corrects it" in text
    assert "motor not known none (60 %) or +2.20 (40 %)" in text
    assert "Not known: this calibration keeps no evidence." in text
    drawn(browser, 1)


def test_report_prints_on_a4_with_complete_figures(page: webdriver.Chrome) -> None:
    vehicle_text(page, "V4")
    drawn(page, 2)
    printed = base64.b64decode(page.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})["data"])
    boxes = [tuple(map(float, box.split())) for box in re.findall(rb"/MediaBox \[([0-9. ]+)\]", printed)]
    assert boxes
    assert all(box == pytest.approx((0, 0, 595, 842), abs=1.0) for box in boxes)
    # Figures are as wide as the paper while printing, and as the screen again afterwards.
    widths = page.execute_script(
        "const wide = () => [...document.querySelectorAll('.plot[data-drawn] .main-svg')].map((at) => at.clientWidth);"
        "window.dispatchEvent(new Event('beforeprint')); return wide();"
    )
    assert set(widths) == {680}
    page.execute_script("window.dispatchEvent(new Event('afterprint'))")
