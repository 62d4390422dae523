"""The page of a large fleet: how long it takes to write, how large it is, and how soon a browser has it ready."""

import shutil
import tempfile
import time
from pathlib import Path
from statistics import median

from selenium import webdriver
from selenium.webdriver.support.wait import WebDriverWait

from bench.fleet_run import calibrated
from bench.fleets import make_store
from bench.row import Row
from calibrator.report.page import report_page

__all__ = ["rows"]

FLEET, QUICK_FLEET = 100_000, 2_000
OPENED = 5
"""How often the page is opened; the median counts."""
PATIENCE_S = 120.0


def rows(*, quick: bool) -> list[Row]:
    """Measure seconds to write the page of a calibrated fleet, its size, and seconds until a browser has it ready."""
    vehicles = QUICK_FLEET if quick else FLEET
    with tempfile.TemporaryDirectory() as folder:
        store, result, page = (Path(folder) / name for name in ("store", "result", "report.html"))
        make_store(store, vehicles=vehicles, branches=3)
        calibrated(store, result)
        started = time.perf_counter()
        page.write_text(report_page(result)[0])
        written_s, ready_s = time.perf_counter() - started, median(ready_times_s(page))
        what = f"report of {vehicles} vehicles"
        return [
            Row(name=f"{what}: written", value=written_s, unit="s"),
            Row(name=f"{what}: size", value=page.stat().st_size / 1e6, unit="MB"),
            Row(name=f"{what}: ready in Chromium, median of {OPENED}", value=ready_s, unit="s"),
        ]


def ready_times_s(page: Path) -> list[float]:
    """Open the page in Chromium some times; return how long each took until it reported table and figures ready. [s]"""
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        raise SystemExit("bench: no chromium and chromedriver here (Debian: apt-get install chromium chromium-driver)")
    options, found = webdriver.ChromeOptions(), []
    options.binary_location = chromium
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1280,1000"):
        options.add_argument(argument)
    with webdriver.Chrome(options=options, service=webdriver.ChromeService(driver)) as browser:
        for _ in range(OPENED):
            browser.get(f"file://{page}")
            ready = WebDriverWait(browser, PATIENCE_S).until(
                lambda it: it.execute_script("return document.body.dataset.ready || document.body.dataset.failed")
            )
            found.append(float(ready) / 1e3)
    return found
