#!/usr/bin/env python3
"""A repository of many vehicles: time and memory to publish all of them, size of a bundle, time to verify it on board.

    python -m bench.repository --vehicles 1000000        (in tools/)

Each vehicle has a parameter file of the size that the calibrator writes. All are published twice, with other contents
the second time, and a vehicle that took the first publication verifies the bundle of the second one.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest.mock import patch

from msgspec.structs import replace
from securesystemslib.signer import SSlibKey
from tuf.api.metadata import SuccinctRoles

from bench.row import LAYOUT
from bench.true_parameters import true_parameters
from calibrator.repository.repository import BIN_BITS
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, encode_parameters
from ecu_node.update.client import provision, update

KEYS = {"root": "root", "targets": "targets", "snapshot": "online", "timestamp": "online"}
"""By role."""
UPDATES = 20
"""Of which the quickest counts: others on the machine make it longer, nothing makes it shorter."""


def calibrator(*words: object) -> float:
    """Run ``calibrator repository``; its time. [s]"""
    start_s = time.perf_counter()
    command = [sys.executable, "-m", "calibrator", "repository", *map(str, words)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start_s


def sampled(vehicles: int) -> list[int]:
    """The vehicles of one bin, and one of each other bin: bundle and snapshot are those of the whole fleet."""
    bins, found = SuccinctRoles([], 1, BIN_BITS, "bins"), dict[str, list[int]]()
    for number in range(vehicles):
        found.setdefault(bins.get_role_for_target(f"V{number:07d}.json"), []).append(number)
    first, *others = found.values()
    return [*first, *(numbers[0] for numbers in others)]


def write_parameters(database: VehicleDatabase, folder: Path, vehicles: Iterable[int], drift: float) -> None:
    """Write a parameter file for each vehicle, with texts as long as a calibration makes them."""
    branch = BranchParameters(
        drift=drift, offset_a=1.5, drift_sd=0.001, offset_sd_a=0.1, apply=True, delay_s=0.01, delay_sd_s=0.001
    )
    found = true_parameters(database, dict.fromkeys(database.layout.branch_names, branch))
    drives = replace(found.provenance, drives=[f"drive-{number:04d}.blf" for number in range(20)])
    content = encode_parameters(replace(found, vehicle="VEHICLE", provenance=drives), "bench")
    folder.mkdir(exist_ok=True)
    for number in vehicles:
        (folder / f"{number:07d}.json").write_bytes(content.replace(b"VEHICLE", b"V%07d" % number))


def measured(folder: Path, vehicles: Iterable[int]) -> dict[str, float]:
    """Publish twice, and verify one bundle."""
    database, now, found = read_database(read_layout(LAYOUT)), datetime.now(UTC), dict[str, float]()
    repository, keys, params, state = (folder / name for name in ("repository", "keys", "params", "state"))
    for name in sorted({*KEYS.values()}):
        calibrator("key", name, "--no-passphrase", "--out", keys)
    calibrator("init", repository, *(w for role, name in KEYS.items() for w in (f"--{role}", keys / f"{name}.pub")))
    private = [word for name in sorted({*KEYS.values()}) for word in ("--key", keys / f"{name}.key")]
    for name, drift in (("first", 0.05), ("all changed", 0.06)):
        write_parameters(database, params, vehicles, drift)
        found[f"{name}: add [s]"] = calibrator("add", repository, params)
        found[f"{name}: publish [s]"] = calibrator("publish", repository, *private)
        print(found, file=sys.stderr)
        if name == "first":
            provision(state, "V0000000", repository / "metadata" / "1.root.json", now)
            update(state, str(repository), database, now)
    found["memory [GiB]"] = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    calibrator("bundle", repository, "V0000000", "--out", folder)
    bundle = folder / "V0000000.json.xz"
    found["bundle [KiB]"] = bundle.stat().st_size / 1024
    times_s, signatures_s, verify = [], list[float](), SSlibKey.verify_signature

    def timed(*arguments: Any) -> None:
        start_s = time.process_time()
        verify(*arguments)
        signatures_s.append(time.process_time() - start_s)

    with patch.object(SSlibKey, "verify_signature", timed):
        for _ in range(UPDATES):
            signatures_s.clear()
            start_s = time.process_time()
            update(state, str(bundle), database, datetime.now(UTC), dry_run=True)
            times_s.append((time.process_time() - start_s, sum(signatures_s)))
    whole_s, of_signatures_s = min(times_s)
    found["verify [ms]"], found["verify without signatures [ms]"] = 1e3 * whole_s, 1e3 * (whole_s - of_signatures_s)
    return found


def main() -> None:
    """Measure, and print as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, default=10_000)
    parser.add_argument("--sampled", action="store_true", help="one bin of the fleet alone: bundle and time to verify")
    parser.add_argument("--folder", type=Path, help="where to work; needs about 15 GB for 10^6 vehicles")
    options = parser.parse_args()
    os.environ.pop("CALIBRATOR_KEY_PASSPHRASE", None)
    with tempfile.TemporaryDirectory(prefix="repository-", dir=options.folder) as folder:
        found = measured(Path(folder), sampled(options.vehicles) if options.sampled else range(options.vehicles))
    print(json.dumps({name: round(value, 3) for name, value in found.items()}, indent=2))


if __name__ == "__main__":
    main()
