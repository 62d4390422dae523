#!/usr/bin/env python3
"""The whole path on one screen: a fleet, its calibration, and one vehicle corrected live on a CAN bus.

Every step is a command that a user could type; it is printed before it runs. The vehicle that drives at the end is
calibrated, but the fleet learns nothing from it, and its drive is not one of those used for calibration.
"""

import shlex
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, takewhile
from pathlib import Path
from typing import Annotated, Any

import can
import pandas as pd
import typer
from matplotlib.figure import Figure

from calibrator.estimator.vehicle_report import explained
from calibrator.fleet_truth import FleetTruth, read_truth
from calibrator.recordings.live import play_frames
from calibrator.recordings.log_formats import read_frames
from calibrator.terminal.command_line import command_app, run_tool
from calibrator.terminal.progress import progress_bar
from ecu_node.bus.node import Node
from ecu_node.bus.steady_bus import SteadyBus
from ecu_node.bus.wiring import Mode, choose_parameters, open_bus, wire
from ecu_node.database import read_database
from ecu_node.errors import UserError
from ecu_node.layout import read_layout
from ecu_node.parameters import read_parameters

ROOT = Path(__file__).resolve().parent.parent
LAYOUT = "dbc/hv_powertrain.toml"
VEHICLES, BRANCHES = 24, 3
HELD_OUT = 3
"""Number of vehicles, those with most faults, that are held out of the learning; the first that may be corrected drives
at the end."""
MINUTES = 4
"""Length of the trip that each vehicle is calibrated on. [min]"""
SECONDS = 12.0
"""Length of the live drive. [s]"""
BUS: dict[str, Any] = {"interface": "virtual", "channel": "demo"}
MARKER = ".made-by-demo"


app = command_app()


@app.command()
def main(
    drives: Annotated[
        str, typer.Option(help="'builtin', or a folder of BMW i3 recordings (.csv, .csv.gz).")
    ] = "builtin",
    out: Annotated[Path, typer.Option(help="Folder for everything the demo makes; it is emptied first.")] = Path(
        "build/demo"
    ),
) -> None:
    """Simulate a fleet, calibrate it, drive one vehicle through the node, and show the Kirchhoff sum."""
    if Path.cwd() != ROOT:
        raise UserError(f"the commands of the demo are those of a checkout: run it in {ROOT}")
    started = time.monotonic()
    make_empty(out)
    fleet, result = out / "fleet", out / "result"
    source = import_recordings(drives, out) if drives != "builtin" else "builtin"
    step(1, f"{VEHICLES} identical vehicles with faulty sensors drive, and log their CAN buses")
    run(
        *("calibrator", "simulate", "--drives", source, "--vehicles", VEHICLES, "--currents", BRANCHES),
        *("--sparsity", 80, "--balanced", "--minutes", MINUTES, "--unseen-minutes", 1),
        *("--layout", LAYOUT, "--out", fleet),
    )
    truth = read_truth(fleet / "truth.json")
    held_out = faulty_vehicles(truth)
    step(2, f"the calibrator learns what each sensor does wrong ({', '.join(held_out)} are held out of the learning)")
    options = [part for name in held_out for part in ("--hold-out", name)]
    run("calibrator", "calibrate", fleet, "--layout", LAYOUT, *options, "--out", result)
    vehicle = corrected_vehicle(result, held_out)
    step(3, "because this fleet is artificial, the truth is known")
    run("calibrator", "score", result, "--truth", fleet / "truth.json")
    run("calibrator", "report", result, "--out", out / "report.html")
    step(4, f"vehicle {vehicle} drives a trip that was not used before, with its node on the bus")
    parameters, unseen = result / "params" / f"{vehicle}.json", fleet / "unseen" / vehicle / "drive.log.gz"
    say(explained(read_parameters(parameters)))
    say(f"put into {vehicle}: {put_in(truth, vehicle)}")
    run("ecu-node", "check", "--params", parameters, "--layout", LAYOUT, "--vehicle", vehicle)
    record_live_drive(parameters, vehicle, log=unseen, recording=out / "live.log")
    step(5, "the Kirchhoff sum of its currents on that trip, before and after")
    run(
        *("calibrator", "kirchhoff", out / "live.log"),
        *("--layout", LAYOUT, "--plot", out / "kirchhoff.html", "--table", out / "kirchhoff.csv"),
    )
    draw_side_by_side(out / "kirchhoff.csv", out / "before_after.png")
    say(f"pictures: {out / 'before_after.png'}, {out / 'kirchhoff.html'}; report: {out / 'report.html'}")
    say(
        f"the same on a virtual bus (ip link add vcan0 type vcan), with .venv/bin in front, each in its own terminal:\n"
        f"  ecu-node run --unsigned --params {parameters} --layout {LAYOUT} --interface socketcan --channel vcan0\n"
        f"  ecu-node monitor --layout {LAYOUT} --interface socketcan --channel vcan0\n"
        f"  calibrator replay {unseen} --interface socketcan --channel vcan0"
    )
    say(f"done in {time.monotonic() - started:.0f} s; everything is in {out}")


def make_empty(out: Path) -> None:
    """Empty the folder of an earlier demo, and no other."""
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not (out / MARKER).exists())):
        raise UserError(f"{out}: is not empty and was not made by the demo; choose another folder")
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (out / MARKER).touch()


def import_recordings(folder: str, out: Path) -> str:
    """Import BMW i3 recordings into a store and return its path; trips that cannot be used are left out."""
    step(0, "recorded trips of a BMW i3 become drives")
    store, tool = out / "store", "tools/import_bmw_i3.py"
    run(sys.executable, tool, folder, "--layout", LAYOUT, "--out", store, may_fail=True)
    if not store.exists():
        raise UserError(f"{folder}: not the BMW i3 recordings; give their folder, or leave DRIVES out")
    return str(store)


def faulty_vehicles(truth: FleetTruth) -> list[str]:
    """Return the vehicles with most faulty sensors, :data:`HELD_OUT` of them."""

    def faulty_sensors(name: str) -> int:
        found = truth.vehicles[name]
        return sum(bool(found.drift[branch] or found.offset_a[branch]) for branch in found.drift)

    return sorted(truth.vehicles, key=faulty_sensors, reverse=True)[:HELD_OUT]


def corrected_vehicle(result: Path, held_out: list[str]) -> str:
    """Return the first held-out vehicle that is corrected, else the first; print why those before are not."""
    for name in held_out:
        found = read_parameters(result / "params" / f"{name}.json")
        if found.verdict == "corrected":
            return name
        say(f"{name}: {found.verdict}; {found.deciding_evidence}")
    say(f"none of them may be corrected, so the node of {held_out[0]} passes the measured currents through")
    return held_out[0]


def record_live_drive(parameters: Path, vehicle: str, *, log: Path, recording: Path) -> None:
    """Play the first seconds of a log onto a bus in real time with the node on it, and record what passes."""
    say(f"python-can's virtual bus; {SECONDS:.0f} s in real time")
    messages = read_frames(log).messages()
    first = next(messages)
    frames = chain([first], takewhile(lambda message: message.timestamp < first.timestamp + SECONDS, messages))
    with (
        running_node(parameters, vehicle),
        can.Bus(**BUS) as ears,
        can.Bus(**BUS) as mouth,
        progress_bar("drive", int(SECONDS), "s") as progress,
        can.Notifier(ears, [can.Logger(recording)], timeout=0.1),
    ):
        for age_s in play_frames(frames, mouth):
            progress(int(age_s) + 1)
        time.sleep(0.3)  # for the last answers


@contextmanager
def running_node(parameters: Path, vehicle: str) -> Iterator[None]:
    """Run the node's own loop in a thread, on the virtual bus, until the block ends."""
    database = read_database(read_layout(ROOT / LAYOUT))
    in_force = choose_parameters(parameters, database, vehicle)
    if in_force.why_not is not None:
        raise UserError(in_force.why_not)
    stop, at_work = threading.Event(), threading.Event()
    corrector = wire(database, in_force, time.monotonic())
    bus = SteadyBus(lambda: open_bus(database, **BUS, fd=False, mode=Mode.OVERLAY), corrector.counters, say)
    run_node = Node(bus, bus, corrector, period_s=0.1).run
    node = threading.Thread(target=run_node, args=(stop.is_set, at_work.set))
    node.start()
    at_work.wait()
    try:
        yield
    finally:
        stop.set()
        node.join()
        bus.close()
    say(f"node: {corrector.counters.text()}")


def put_in(truth: FleetTruth, vehicle: str) -> str:
    """Return in words the faults that were put into the sensors of a vehicle."""
    faults = truth.vehicles[vehicle]
    gains = [f"{name} gain error {100.0 * value:+.2f}%" for name, value in faults.drift.items() if value]
    return ", ".join(gains + [f"{name} offset {value:+.2f} A" for name, value in faults.offset_a.items() if value])


def draw_side_by_side(table: Path, picture: Path) -> None:
    """Draw the currents and their sum, as measured and as corrected: the picture of the README."""
    found = pd.read_csv(table, index_col="time_s")
    names = found.loc[:, :"sum_a"].columns.str.removesuffix("_a")
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    for axis, after in zip(figure.subplots(1, 2, sharey=True), ("", "_corrected"), strict=True):
        shown = found[[f"{name}{after}_a" for name in names]].set_axis(names, axis=1)
        title = f"{after[1:] or 'measured'}: sum {(shown['sum'] ** 2).mean() ** 0.5:.1f} A RMS"
        shown.plot(ax=axis, title=title, style={"sum": "k"}, lw=1.0, grid=True, legend=False, xlabel="time [s]")
    figure.axes[0].set_ylabel("current into the junction [A]")
    figure.axes[1].legend(loc="lower left")
    figure.savefig(picture, dpi=120)


def run(*command: object, may_fail: bool = False) -> None:
    """Run a command of the project, as it is in this environment, and show it; stop the demo if it fails."""
    say(f"\n$ {shlex.join(['python' if word == sys.executable else str(word) for word in command])}")
    first, *rest = map(str, command)
    code = subprocess.run([Path(sys.executable).parent / first, *rest], check=False).returncode
    if code and not may_fail:
        raise SystemExit(code)


def step(number: int, text: str) -> None:
    """Announce a step."""
    say(f"\n=== {number}. {text}")


def say(text: str) -> None:
    """Print a line."""
    print(text, flush=True)


if __name__ == "__main__":
    run_tool(app, "demo")
