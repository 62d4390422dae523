"""A repository of many vehicles: time and memory to publish all of them, size of a bundle, time to verify it on board.

    python -m bench.repository --vehicles 1000000        (in tools/)

Each vehicle has a parameter file of the size that the calibrator writes. All are published twice, with other contents
the second time, and a vehicle that took the first publication verifies the bundle of the second one.
"""

import resource
import tempfile
import time
from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest.mock import patch

import typer
from msgspec import structs
from securesystemslib.signer import SSlibKey
from tuf.api.metadata import SuccinctRoles

from bench.published import Publisher
from bench.row import LAYOUT, Row, show
from bench.true_parameters import true_parameters
from calibrator.repository.repository import BIN_BITS
from ecu_node.database import VehicleDatabase, read_database
from ecu_node.layout import read_layout
from ecu_node.parameters import BranchParameters, encode_parameters
from ecu_node.update.client import provision, update

UPDATES = 20
"""Number of updates, of which the quickest counts: other work on the machine can only make them longer."""


def one_bin(vehicles: int) -> list[int]:
    """Return the numbers of all vehicles of one bin of the metadata, and of one vehicle of each other bin.

    Bundle and snapshot are then as large as for the whole fleet.
    """
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
    drives = structs.replace(found.provenance, drives=[f"drive-{number:04d}.blf" for number in range(20)])
    content = encode_parameters(structs.replace(found, vehicle="VEHICLE", provenance=drives), "bench")
    folder.mkdir(exist_ok=True)
    for number in vehicles:
        (folder / f"{number:07d}.json").write_bytes(content.replace(b"VEHICLE", b"V%07d" % number))


def measured(folder: Path, vehicles: Iterable[int]) -> list[Row]:
    """Measure two publications, and the update of a vehicle from a bundle of the second one."""
    database, now, found = read_database(read_layout(LAYOUT)), datetime.now(UTC), list[Row]()
    publisher, params, state = Publisher(folder / "repository"), folder / "params", folder / "state"
    for name, drift in (("first", 0.05), ("all changed", 0.06)):
        write_parameters(database, params, vehicles, drift)
        times_s = [time.perf_counter()]
        publisher.add(sorted(params.iterdir()))
        times_s.append(time.perf_counter())
        publisher.publish()
        times_s.append(time.perf_counter())
        found.append(Row(name=f"{name}: add", value=times_s[1] - times_s[0], unit="s"))
        found.append(Row(name=f"{name}: publish", value=times_s[2] - times_s[1], unit="s"))
        if name == "first":
            provision(state, "V0000000", publisher.root, now)
            update(state, str(publisher.folder), database, now)
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    bundle = folder / "V0000000.json.xz"
    bundle.write_bytes(publisher.bundle("V0000000"))
    whole_s, signatures_s = verify_times_s(state, bundle, database)
    return [
        *found,
        Row(name="memory", value=peak_gib, unit="GiB"),
        Row(name="bundle", value=bundle.stat().st_size / 1024, unit="KiB"),
        Row(name="verify", value=1e3 * whole_s, unit="ms"),
        Row(name="verify without signatures", value=1e3 * (whole_s - signatures_s), unit="ms"),
    ]


def verify_times_s(state: Path, bundle: Path, database: VehicleDatabase) -> tuple[float, float]:
    """Return the processor time of the quickest update, and the part of it that went into signatures. [s]"""
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
    return min(times_s)


def rows(*, quick: bool) -> list[Row]:
    """Measure the update of one of 10^6 vehicles, or of 10^4 in a quick run."""
    vehicles = 10_000 if quick else 1_000_000
    with tempfile.TemporaryDirectory(prefix="repository-") as folder:
        found = measured(Path(folder), one_bin(vehicles))
    return [replace(row, name=f"update of one of {vehicles:,}: {row.name}") for row in found[-3:]]


def main(*, vehicles: int = 10_000, sampled: bool = False) -> None:
    """Measure a repository; if sampled, with one bin of the fleet alone, enough for bundle size and time to verify.

    10^6 vehicles need about 15 GB in the folder for temporary files (TMPDIR).
    """
    with tempfile.TemporaryDirectory(prefix="repository-") as folder:
        show(measured(Path(folder), one_bin(vehicles) if sampled else range(vehicles)))


if __name__ == "__main__":
    typer.run(main)
