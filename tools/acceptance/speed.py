"""Promises about time, memory and load, from ``bench.all`` and what the long benchmarks print."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from acceptance.row import MissingFigureError, Promise, at_least, at_most

__all__ = ["million_promises", "speed_promises"]

Found = dict[str, Any]
"""One row of ``bench.all``, see :class:`bench.row.Row`."""


def speed_promises(*paths: Path) -> Iterator[Promise]:
    """Judge the rows that ``bench.all`` wrote, in one file or in several."""
    rows: list[Found] = [row for path in paths for row in json.loads(path.read_text(encoding="utf-8"))]

    def row(*words: str) -> Found:
        found = [each for each in rows if all(word in f"{each['name']} {each['peer'] or ''}" for word in words)]
        if len(found) != 1:
            raise MissingFigureError(f"bench: {len(found)} rows of {', '.join(words)}; one is expected")
        return found[0]

    yield from _calibrator(row, rows)
    yield from _node(row)
    yield from _socketcan(row)


def million_promises(path: Path) -> Iterator[Promise]:
    """Judge what ``bench.fleet_run --vehicles 1000000`` printed."""
    found = re.search(r"^1000000 vehicles: (\d+) s, (\d+) MiB$", path.read_text(encoding="utf-8"), re.MULTILINE)
    if found is None:
        raise MissingFigureError(f"{path}: no figure of 1000000 vehicles")
    yield at_most("10^6 vehicles from summaries to parameters", (15.0,), (int(found[1]) / 60.0,), unit="min")
    yield at_most("10^6 vehicles: peak memory", (4.0,), (int(found[2]) / 1024.0,), unit="GiB")


def _calibrator(row: Callable[..., Found], rows: list[Found]) -> Iterator[Promise]:
    peers = ("nfoursid", "sippy")
    times = [row("identify a vehicle", peer)["ratio"] for peer in peers]
    yield at_least("identify a vehicle: times as fast as nfoursid / sippy", (1000.0, 30.0), times)
    errors = [row("slope error at SNR 20", peer)["ratio"] for peer in peers]
    yield at_least("identify a vehicle: slope error, times better than either", (1.0, 1.0), errors)
    for name, bars in (("l1 optimum", (500.0, 100.0)), ("posterior", (20.0, 10.0))):
        least = [
            min(each["ratio"] for each in rows if each["name"].startswith(f"{name}, K = {K},") and each["ratio"])
            for K in (2, 4)
        ]
        yield at_least(f"recover a vehicle, {name}: times as fast as cvxpy, K = 2 / 4", bars, least)
    kinds, least_ratios = ("BLF", "candump", "ASC", "MF4"), (25.0, 25.0, 10.0, 5.0)
    ratios = [row(f"{kind} log to drive")["ratio"] for kind in kinds]
    yield at_least(
        f"ingest frames: times as fast as python-can and cantools, {' / '.join(kinds)}", least_ratios, ratios
    )
    for what, words in (("time per vehicle", "once the reference is known"), ("peak memory", "peak memory of all")):
        values = [row(f"{count} vehicles from summaries", words)["value"] for count in (1000, 10_000, 100_000)]
        apart = max(values) / min(values) - 1.0
        yield at_most(f"10^3, 10^4, 10^5 vehicles: {what} differs by", (20.0,), (100.0 * apart,), unit="%")
    killed = row("runs killed at random moments")
    count = float(killed["name"].rpartition(" ")[2])
    yield at_least("runs killed at random moments that give the identical result", (count,), (killed["value"],))
    page = [row("report of", ": size")["value"], row("ready in Chromium")["value"]]
    yield at_most("report of 10^5 vehicles: size [MB] / ready in Chromium [s]", (10.0, 3.0), page)


def _node(row: Callable[..., Found]) -> Iterator[Promise]:
    frames = [row(f"branch frame, {mode}") for mode in ("overlay", "gateway")]
    yield at_most("work per branch frame, overlay / gateway", (2.5, 2.5), [each["value"] for each in frames], unit="us")
    yield at_least("the same: times as fast as cantools", (4.0, 4.0), [each["ratio"] for each in frames])
    bare, plain = (
        [row(f"virtual bus, {mode} beside {peer}", "time per frame")["ratio"] for mode in ("gateway", "overlay")]
        for peer in ("bare loop", "plain")
    )
    slower = [1.0 / ratio for ratio in bare]
    yield at_most("virtual bus, gateway / overlay: time against the bare loop", (1.5, 1.5), slower)
    yield at_least("virtual bus, gateway / overlay: times as fast as the plain version", (3.0, 3.0), plain)
    lost = [row("frames/s, 10,000,000 frames", part)["value"] for part in (": lost", ": out of order")]
    yield at_most("a full CAN FD bus, 10^7 frames: lost / out of order or wrong", (0.0, 0.0), lost)
    start = row("process to first corrected frame")["value"]
    yield at_most("start to the first corrected frame", (0.5,), (start,), unit="s")
    memory = [row("memory after 10,000,000 frames")["value"], row("growth from the first frame")["value"]]
    yield at_most("memory after 10^7 frames / its growth", (48.0, 1.0), memory, unit="MiB")


def _socketcan(row: Callable[..., Found]) -> Iterator[Promise]:
    bare, plain = (row(f"SocketCAN, {name}: rate")["ratio"] for name in ("bare loop", "plain"))
    yield at_most("SocketCAN: time against the bare loop", (1.5,), (bare,))
    yield at_least("SocketCAN: times as fast as the plain version", (3.0,), (1.0 / plain,))
