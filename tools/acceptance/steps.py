"""What measures: one command after the other, each with the files that its figures depend on."""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["BENCHES", "PYTHON", "Step", "bench_file", "steps"]

PYTHON = sys.executable
LAYOUT = "dbc/hv_powertrain.toml"
CODE = ("calibrator", "ecu_node", "dbc")
EVERYTHING = (".",)
TOOLS = {"PYTHONPATH": "tools"}
PAPER = ("classifier", "snr", "sparsity", "statespace", "asymmetry")
RECORDED = ("real", "delay", "data", "phase", "attacks", "coverage")
"""Experiments on drives that all vehicles share, and on recorded trips."""
BENCHES = {
    "identification": ("tools/bench/identification.py", "dbc"),
    "posterior": ("tools/bench/posterior.py", "dbc"),
    "ingest": ("tools/bench/ingest.py", "dbc"),
    "fleet run": ("tools/bench/fleet_run.py", "calibrator/estimator", "dbc"),
    "node": (
        *(f"tools/bench/node{part}.py" for part in ("", "_child", "_peer", "_socketcan")),
        "tools/with_vcan",
        "ecu_node",
    ),
    "fleet report": ("tools/bench/fleet_report.py", "dbc"),
}
"""Groups of ``bench.all``, and what they run."""
SINGLE = {**TOOLS, "OMP_NUM_THREADS": "1"}


@dataclass(frozen=True, kw_only=True)
class Step:
    """One command; what it prints is kept.

    Attributes
    ----------
    name : str
        Name of its files in the folder, with ``_`` for blanks.
    command : tuple of str
        Program and arguments.
    runs : tuple of str
        Files and folders of the checkout that its figures depend on, with what they import.
    environment : mapping of str to str
        Variables besides those of the caller.
    feeds : tuple of str
        Names of later steps that go on with what this one writes.
    """

    name: str
    command: tuple[str, ...]
    runs: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict)
    feeds: tuple[str, ...] = ()


def steps(out: Path, recorded: Path) -> Iterator[Step]:
    """What measures, in an order that shows the most first."""
    yield from _tests(out)
    for name, runs in BENCHES.items():
        yield Step(
            name=f"bench {name}",
            command=(PYTHON, "-m", "bench.all", "--only", name, "--out", str(bench_file(out, name))),
            runs=runs,
            environment=SINGLE,
        )
    yield from _experiments(out, recorded)
    yield from _trials()


def bench_file(out: Path, name: str) -> Path:
    """Rows of a group of ``bench.all``."""
    return out / f"bench_{name.replace(' ', '_')}.json"


def _tests(out: Path) -> Iterator[Step]:
    """All tests, and what they reach."""
    pytest = (PYTHON, "-m", "pytest", "-q", "--cov-report=")
    covered = str(out / "coverage")
    yield Step(
        name="tests",
        command=(*pytest, "--cov", "--numprocesses", "auto", "--dist", "worksteal", f"--junitxml={out / 'tests.xml'}"),
        runs=EVERYTHING,
        environment={"HV_REQUIRE_ALL": "1", "COVERAGE_FILE": covered},
        feeds=("vcan", "coverage"),
    )
    fleet = str(out / "vcan_fleet")
    node = ("--cov=ecu_node", "--cov-append")  # of all packages it takes a node longer to end than it may
    yield Step(
        name="fleet of vcan", command=(PYTHON, "-m", "tests.vcan.calibrated_fleet", fleet), runs=("tests/vcan", *CODE)
    )
    yield Step(
        name="vcan",
        command=("tools/with_vcan", *pytest, "tests/vcan", *node, f"--junitxml={out / 'vcan.xml'}"),
        runs=EVERYTHING,
        environment={"HV_REQUIRE_ALL": "1", "HV_CALIBRATED_FLEET": fleet, "COVERAGE_FILE": covered},
        feeds=("coverage",),
    )
    yield Step(
        name="coverage",
        command=(PYTHON, "-m", "coverage", "json", "-o", str(out / "coverage.json")),
        runs=EVERYTHING,
        environment={"COVERAGE_FILE": covered},
    )


def _experiments(out: Path, recorded: Path) -> Iterator[Step]:
    """The recorded trips as drives, and every experiment."""
    trips, layout = str(out / "i3"), ("--layout", LAYOUT)
    yield Step(
        name="trips",
        command=(PYTHON, "tools/import_bmw_i3.py", str(recorded), *layout, "--out", trips),
        runs=("tools/import_bmw_i3.py", "dbc"),
        environment=TOOLS,
    )
    recordings = ("--drives", trips, *layout)
    for name in (*PAPER, *RECORDED, "calibration"):
        options = (*(recordings if name in RECORDED else ()), "--out", str(out / "experiments"))
        yield Step(
            name=f"experiment {name}",
            command=(PYTHON, "-m", "calibrator", "experiment", name, *options),
            runs=("calibrator/experiments", "tools/import_bmw_i3.py", "dbc"),
            feeds=() if name == "calibration" else ("experiment calibration",),
        )


def _trials() -> Iterator[Step]:
    """A fleet from its drives to the road, random frames and files, and a million vehicles."""
    chain = ("--vehicles", "500", "--minutes", "5", "--unmeasured", "2", "0.5", "--json")
    yield Step(
        name="chain",
        command=(PYTHON, "tools/trust_chain.py", *chain),
        runs=("tools/trust_chain.py", *CODE),
        environment=TOOLS,
    )
    yield Step(
        name="update fuzz",
        command=(PYTHON, "-m", "bench.update_fuzz", "--seed", "7"),
        runs=("tools/bench/update_fuzz.py", "dbc"),
        environment=TOOLS,
    )
    for seed in ("31", "32"):
        yield Step(
            name=f"node fuzz {seed}",
            command=(PYTHON, "-m", "bench.node_fuzz", "--frames", "5000000", "--seed", seed),
            runs=("tools/bench/node_fuzz.py", "dbc"),
            environment=TOOLS,
        )
    yield Step(
        name="million",
        command=(PYTHON, "-m", "bench.fleet_run"),
        runs=("tools/bench/fleet_run.py", "calibrator/estimator", "dbc"),
        environment=SINGLE,
    )
