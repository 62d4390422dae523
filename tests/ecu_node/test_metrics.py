"""Metrics as Prometheus gets them: over HTTP, from a running node."""

import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest

from ecu_node.bus.telemetry import serve_metrics
from ecu_node.bus.wiring import InForce, wire
from ecu_node.core.status import Counters, Latency, Reason, State
from ecu_node.database import VehicleDatabase
from tests.ecu_node.vehicles import LAYOUT


def command(tmp_path: Path, port: int) -> list[str]:
    files = ["--unsigned", "--params", str(tmp_path / "none.json"), "--layout", str(LAYOUT)]
    return [
        *(sys.executable, "-m", "ecu_node", "run", *files, "--interface", "virtual", "--channel", "metrics"),
        *("--metrics-port", str(port)),
    ]


@pytest.fixture
def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


@pytest.fixture
def node(tmp_path: Path, free_port: int) -> Iterator[int]:
    """A node without parameters, and the port on which it answers."""
    with subprocess.Popen(command(tmp_path, free_port), stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        while "running on" not in (line := process.stderr.readline()):
            assert line, "the node has ended"
        yield free_port
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 0


def asked(port: int) -> dict[str, float]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        text = answer.read().decode()
    return {name: float(value) for name, value in re.findall(r"^(ecu_node_\w+) (\S+)$", text, re.MULTILINE)}


def test_every_counter_is_told_and_the_state(node: int) -> None:
    told = asked(node)
    assert {f"ecu_node_{field.name}_total" for field in fields(Counters)} <= told.keys()
    assert all(told[f"ecu_node_{field.name}_total"] == 0.0 for field in fields(Counters))
    assert told["ecu_node_state"] == State.PASSING_THROUGH
    assert told["ecu_node_reason"] == Reason.NO_PARAMETERS
    assert told["ecu_node_parameter_set"] == 0.0
    assert "ecu_node_sum_measured_amperes" not in told


def test_latency_is_a_histogram(database: VehicleDatabase, free_port: int) -> None:
    latency = Latency()
    latency.counts[7], latency.counts[40] = 3, 1
    serve_metrics(wire(database, InForce(parameters=None), 0.0), latency, free_port)
    with urllib.request.urlopen(f"http://127.0.0.1:{free_port}/metrics", timeout=10) as answer:
        text = answer.read().decode()
    found = {float(le): float(count) for le, count in re.findall(r'latency_seconds_bucket\{le="(.+)"\} (.+)', text)}
    assert found == {2.0**bits * 1e-6: 3.0 * (bits >= 7) for bits in range(21)} | {float("inf"): 4.0}


def test_a_port_that_cannot_be_had_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        number = taken.getsockname()[1]
        result = subprocess.run(command(tmp_path, number), capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 1
    assert result.stderr.startswith(f"ecu-node: port {number}: cannot answer there: ")
    assert result.stderr.endswith("; give another --metrics-port\n")
    assert result.stderr.count("\n") == 1


def test_without_the_client_one_line_says_what_to_install(tmp_path: Path) -> None:
    arguments = command(tmp_path, 9464)[3:]
    without = "import sys; sys.modules['prometheus_client'] = None; from ecu_node.cli import main; "
    code = f"{without} sys.exit(main({arguments!r}))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (result.returncode, result.stderr) == (
        1,
        "ecu-node: --metrics-port needs prometheus-client; install it with "
        "pip install 'hv-current-correction[metrics]'\n",
    )
