"""Promises that tests keep, what they reach, fuzzers, and the chain from drives to the road."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

from acceptance.row import MissingFigureError, Promise, at_least, at_most

__all__ = ["chain_promises", "coverage_promises", "fuzz_promises", "promises_of_tests"]

TESTED = {
    "SocketCAN kernel: canplayer, node, candump; bit-exact, others untouched, sum falls tenfold": ("vcan",),
    "Tesla log: sum of 4.1 A +- 1.2 A": ("real.test_tesla_model3",),
    "real trips: import, delays": ("real.test_i3_import", "real.test_delays_i3"),
    "from log to Kirchhoff plot in at most 5 commands; inverted sign, factor 1000, 200 ms found": (
        "real.test_first_minutes",
    ),
    "bad input: one line, the rest goes on": ("test_user_mistakes", "calibrator.test_fleet_commands"),
    "fault table: a test per row": ("ecu_node.test_fault_table", "vcan.test_faults_on_vcan"),
    "parameter files that were tampered with, expired, replayed, of others: refused": ("trust",),
    "C core, A2L, DCM, CDFX, HEX: read back, flashed, bit-identical": ("calibrator.export",),
    "report: numbers equal results.parquet": ("calibrator.report",),
    "report in Chromium: no console error, filters, keyboard, contrast, no request": ("browser",),
    "documents: links, references, words": ("docs",),
    "the node imports nothing heavy; rooms import only rooms before them": ("tools.test_architecture",),
    "all tests": ("",),
}
"""Promises, and the beginnings of the names of the tests that keep them."""


def promises_of_tests(*reports: Path) -> Iterator[Promise]:
    """Judge JUnit reports: every test that keeps a promise ran and passed."""
    outcomes = {}
    for report in reports:
        for case in ET.parse(report).iter("testcase"):  # noqa: S314 (of pytest)
            name = case.get("classname", "").removeprefix("tests.")
            outcomes[f"{name}::{case.get('name')}"] = len(case) == 0 or all(part.tag == "system-out" for part in case)
    for what, begins in TESTED.items():
        seen = [passed for name, passed in outcomes.items() if name.startswith(begins)]
        if not seen:
            raise MissingFigureError(f"no test of {', '.join(begins)} ran")
        yield Promise(
            what=what, bar="every test passes, none skipped", figure=f"{sum(seen)} of {len(seen)} pass", met=all(seen)
        )


def coverage_promises(path: Path) -> Iterator[Promise]:
    """Judge what ``coverage json`` wrote: lines and branches that tests reach."""
    files = json.loads(path.read_text(encoding="utf-8"))["files"]
    for package, bar in (("ecu_node", 100.0), ("calibrator", 95.0)):
        counts = [found["summary"] for name, found in files.items() if name.startswith(f"{package}/")]
        reached = sum(count["covered_lines"] + count["covered_branches"] for count in counts)
        total = sum(count["num_statements"] + count["num_branches"] for count in counts)
        if total == 0:
            raise MissingFigureError(f"{path}: nothing of {package}")
        yield at_least(
            f"tests: lines and branches of {package} that they reach", (bar,), (100.0 * reached / total,), unit="%"
        )


def fuzz_promises(node: list[Path], update: Path) -> Iterator[Promise]:
    """Judge what the fuzzers printed."""
    frames = sum(_counted(path, r"^(\d+) frames right in both modes") for path in node)
    yield at_least("node: random frames that are right in both modes, no exception", (1e7,), (frames,))
    bundles = _counted(update, r"^(\d+) changed bundles refused, each in one line")
    yield at_least("changed bundles: none accepted, no crash", (1e6,), (bundles,))


def chain_promises(path: Path) -> Iterator[Promise]:
    """Judge what ``tools/trust_chain.py --json`` printed of 500 vehicles."""
    counts = json.loads(path.read_text(encoding="utf-8"))
    if counts["vehicles"] != 500:
        raise MissingFigureError(f"{path}: {counts['vehicles']} vehicles; 500 are expected")
    corrected = counts["with_corrections"]
    yield at_most("500 vehicles from drives to the road: made worse", (0.0,), (counts["made_worse"],))
    in_force = 100.0 * counts["deployed"] / corrected
    yield at_least(f"the same: in force after their trial, of {corrected} sets", (90.0,), (in_force,), unit="%")


def _counted(path: Path, pattern: str) -> int:
    found = re.search(pattern, path.read_text(encoding="utf-8"), re.MULTILINE)
    if found is None:
        raise MissingFigureError(f"{path}: no line like {pattern}")
    return int(found[1])
