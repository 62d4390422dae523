"""The page of a large fleet: how long it takes to write, how large it is, and how soon a browser has it ready."""

import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from selenium import webdriver
from selenium.webdriver.support.wait import WebDriverWait

from bench.row import LAYOUT, Row, run
from bench.true_parameters import true_parameters
from calibrator.estimator.evidence import VehicleEvidence, evidence_names
from calibrator.estimator.results import PARTS, RunRecord, encode_chunk, join_rows, part_file, write_run
from calibrator.report.page import fleet_report
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, Explanation, HardwareFault, JunctionResidual, VehicleParameters

__all__ = ["rows"]

FLEET, QUICK_FLEET = 100_000, 2_000
BRANCHES = ("battery", "motor", "auxiliary")
FULL_SCALE_A = 400.0
FAULTY, UNDECIDED, SUSPECTED = 0.2, 0.1, 0.02
"""Share of the sensors with a fault, of the vehicles of which it cannot be told, and with a hardware fault. [1]"""
OPENED = 5
"""How often the page is opened; the median counts."""
PATIENCE_S = 120.0


def rows(*, quick: bool) -> list[Row]:
    """Measure seconds to write the page, its size, and seconds from opening it to its being ready."""
    vehicles = QUICK_FLEET if quick else FLEET
    with tempfile.TemporaryDirectory() as folder:
        result, page = Path(folder) / "result", Path(folder) / "report.html"
        write_result(result, vehicles)
        started = time.perf_counter()
        page.write_text(fleet_report(result)[0])
        written_s, ready_s = time.perf_counter() - started, float(np.median(ready_times_s(page)))
        what = f"report of {vehicles} vehicles"
        return [
            Row(name=f"{what}: written", value=written_s, unit="s"),
            Row(name=f"{what}: size", value=page.stat().st_size / 1e6, unit="MB"),
            Row(name=f"{what}: ready in Chromium, median of {OPENED}", value=ready_s, unit="s"),
        ]


def write_result(folder: Path, vehicles: int) -> None:
    """Write a result as a calibration does, with faults drawn as in the paper."""
    rng, like = np.random.default_rng(0), true_parameters(read_database(read_layout(LAYOUT)), {})
    items = [drawn_vehicle(rng, replace(like, vehicle=f"WVW{number:014d}")) for number in range(vehicles)]
    (folder / PARTS).mkdir(parents=True)
    evidence = {item.vehicle: drawn_evidence(rng, item) for item in items}
    part_file(folder, 0).write_bytes(encode_chunk(items, {}, evidence=evidence))
    join_rows(folder, {})  # no file per vehicle, as of every large fleet
    record = RunRecord(
        tool="bench",
        method="posterior",
        fleet="bench",
        layout="bench",
        branches=list(BRANCHES),
        model_inputs=[],
        settings={},
        created="2026-01-01T00:00:00Z",
        details={"evidence": evidence_names(BRANCHES)},
        vehicles=vehicles,
        full_scale_a=FULL_SCALE_A,
        left_out={},
        notices=[],
    )
    write_run(folder, record)


def drawn_vehicle(rng: np.random.Generator, like: VehicleParameters) -> VehicleParameters:
    """Parameters of one vehicle."""
    undecided, suspected = bool(rng.random() < UNDECIDED), bool(rng.random() < SUSPECTED)
    branches = {branch: drawn_sensor(rng, apply=not undecided) for branch in BRANCHES}
    found = any(branch.drift or branch.offset_a for branch in branches.values())
    explanations = [
        Explanation(probability=p, drift={"battery": rng.normal(0.0, 0.1)}, offset_a={"motor": rng.normal()})
        for p in ((0.5, 0.4, 0.1) if undecided else ())
    ]
    hardware_drift = 0.1 * rng.normal() if suspected else 0.0
    return replace(
        like,
        verdict="cannot tell" if undecided else "corrected" if found else "no sensor fault",
        confidence=rng.uniform(0.3, 1.0),
        branches=branches,
        hardware_fault=HardwareFault(suspected=suspected, probability=rng.random(), drift=hardware_drift),
        explanations=explanations,
        deciding_evidence=f"a zero-current window would decide: {rng.normal():+.1f} A" if undecided else "",
        junction_residual=JunctionResidual(measured_a=rng.exponential(20.0), corrected_a=rng.exponential(1.0)),
        provenance=replace(like.provenance, drives=["d"], duration_s=rng.uniform(600.0, 36000.0)),
    )


def drawn_sensor(rng: np.random.Generator, *, apply: bool) -> BranchParameters:
    """One sensor, with a fault or not."""
    size = rng.choice([-1.0, 1.0], 2) * rng.uniform(0.05, 0.25, 2) * (rng.random(2) < FAULTY)
    faulty = bool(size.any())
    return BranchParameters(
        drift=float(size[0]),
        offset_a=float(size[1]) * FULL_SCALE_A,
        drift_sd=rng.exponential(0.002),
        offset_sd_a=rng.exponential(0.3),
        apply=apply and faulty,
        held_back="harm limit" if faulty and not apply else None,
        delay_s=rng.normal(0.0, 0.02),
        fault_probability=rng.random(),
        harm_probability=0.001 * rng.random(),
    )


def drawn_evidence(rng: np.random.Generator, item: VehicleParameters) -> VehicleEvidence:
    """Rows as full of digits as real ones."""
    count, unread = 5 * len(BRANCHES), [5, 6, 7, 12, 13, 14]
    value, sd = rng.normal(0.0, 10.0, count), rng.exponential(0.1, count)
    value[: len(BRANCHES)] = 1.0 + np.array([branch.drift for branch in item.branches.values()])
    explained = (value + sd * rng.normal(size=count)).tolist()
    read, read_sd = ([None if r in unread else x for r, x in enumerate(some.tolist())] for some in (value, sd))
    return VehicleEvidence(value=read, sd=read_sd, explained=explained)


def ready_times_s(page: Path) -> list[float]:
    """From opening the page in Chromium to its table and first figures being ready, as the page itself tells. [s]"""
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


if __name__ == "__main__":
    run(rows)
