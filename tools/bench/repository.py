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
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest.mock import patch

from msgspec.structs import replace
from securesystemslib.signer import SSlibKey
from tuf.api.metadata import SuccinctRoles
from tuf.api.serialization.json import CanonicalJSONSerializer, JSONDeserializer

from bench.true_parameters import true_parameters
from calibrator.repository.repository import BIN_BITS
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, encode_parameters
from ecu_node.update.client import provision, update

_LAYOUT = Path(__file__).parents[2] / "dbc" / "hv_powertrain.toml"
_UPDATES = 20


def calibrator(*words: object) -> float:
    """Run ``calibrator repository``; its time. [s]"""
    start_s = time.perf_counter()
    command = [sys.executable, "-m", "calibrator", "repository", *map(str, words)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start_s


def sampled(vehicles: int) -> list[int]:
    """The vehicles of one bin, and one of each other bin: bundle and snapshot are those of the whole fleet."""
    bins = SuccinctRoles([], 1, BIN_BITS, "bins")
    found: dict[str, list[int]] = {}
    for number in range(vehicles):
        found.setdefault(bins.get_role_for_target(f"V{number:07d}.json"), []).append(number)
    return [*next(iter(found.values())), *(numbers[0] for numbers in list(found.values())[1:])]


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
    database = read_database(read_layout(_LAYOUT))
    repository, keys, params = folder / "repository", folder / "keys", folder / "params"
    for name in ("root", "targets", "online"):
        calibrator("key", name, "--no-passphrase", "--out", keys)
    roles = {"root": "root", "targets": "targets", "snapshot": "online", "timestamp": "online"}
    calibrator(
        "init", repository, *(word for role, name in roles.items() for word in (f"--{role}", keys / f"{name}.pub"))
    )
    private = [word for name in ("root", "targets", "online") for word in ("--key", keys / f"{name}.key")]
    found: dict[str, float] = {}
    for name, drift in (("first", 0.05), ("all changed", 0.06)):
        write_parameters(database, params, vehicles, drift)
        found[f"{name}: add [s]"] = calibrator("add", repository, params)
        found[f"{name}: publish [s]"] = calibrator("publish", repository, *private)
        print(found, file=sys.stderr)
        if name == "first":
            provision(folder / "state", "V0000000", repository / "metadata" / "1.root.json", datetime.now(UTC))
            update(folder / "state", str(repository), database, datetime.now(UTC))
    found["memory [GiB]"] = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    calibrator("bundle", repository, "V0000000", "--out", folder)
    bundle = folder / "V0000000.json.xz"
    found["bundle [KiB]"] = bundle.stat().st_size / 1024
    return found | time_to_verify(folder / "state", bundle, database)


def time_to_verify(state: Path, bundle: Path, database: VehicleDatabase) -> dict[str, float]:
    """Processor time of an update on board, and of its parts, which python-tuf's modules are asked for one by one."""
    parts_s = dict.fromkeys(("signatures", "canonical JSON", "reading metadata"), 0.0)

    def timed(part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def measured_work(*arguments: Any) -> Any:
            start_s = time.process_time()
            try:
                return work(*arguments)
            finally:
                parts_s[part] += time.process_time() - start_s

        return measured_work

    def updates_s() -> float:
        times_s = []
        for _ in range(_UPDATES):
            start_s = time.process_time()
            update(state, str(bundle), database, datetime.now(UTC), dry_run=True)
            times_s.append(time.process_time() - start_s)
        return min(times_s)  # others on the machine make it longer, nothing makes it shorter

    found = {"verify [ms]": 1e3 * updates_s()}
    with (
        patch.object(SSlibKey, "verify_signature", timed("signatures", SSlibKey.verify_signature)),
        patch.object(CanonicalJSONSerializer, "serialize", timed("canonical JSON", CanonicalJSONSerializer.serialize)),
        patch.object(JSONDeserializer, "deserialize", timed("reading metadata", JSONDeserializer.deserialize)),
    ):
        updates_s()
    found |= {f"of this {part} [ms]": 1e3 * total_s / _UPDATES for part, total_s in parts_s.items()}
    found["verify without signatures [ms]"] = found["verify [ms]"] - found["of this signatures [ms]"]
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
