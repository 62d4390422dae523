"""From a fleet's logs to corrected frames on a real bus: the calibrator's own parameters, on an unseen drive."""

import gzip
import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from ecu_node.core.status import Quality
from ecu_node.database import VehicleDatabase
from ecu_node.parameters import VehicleParameters, read_parameters
from tests.vcan.calibrated_fleet import make_calibrated_fleet
from tests.vcan.conftest import StartNode
from tests.vcan.patient_layout import LAYOUT
from tests.vcan.processes import Recording, frames_of, play
from tests.vcan.small_drive import BRANCHES

SECONDS = 8.0


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fleet beside its result, made here unless it was before."""
    made = os.environ.get("HV_CALIBRATED_FLEET")
    folder = Path(made) if made else tmp_path_factory.mktemp("calibrated")
    if not made:
        make_calibrated_fleet(folder)
    return folder / "fleet"


def faulty_vehicle(fleet: Path) -> tuple[str, VehicleParameters]:
    """The first vehicle whose sensors were found to be faulty."""
    for path in sorted((fleet.parent / "result" / "params").glob("*.json")):
        parameters = read_parameters(path)
        if parameters.verdict == "corrected":
            return path.stem, parameters
    raise AssertionError("no vehicle was corrected")


def write_start_of_unseen_drive(fleet: Path, vehicle: str, target: Path) -> None:
    lines = gzip.decompress((fleet / "unseen" / vehicle / "drive.log.gz").read_bytes()).decode().splitlines()
    target.write_text("\n".join(line for line in lines if float(line[1 : line.index(")")]) < SECONDS) + "\n")


def test_correction_reduces_kirchhoff_sum_tenfold_on_an_unseen_drive(
    fleet: Path, database: VehicleDatabase, tmp_path: Path, start_node: StartNode, recording: Recording
) -> None:
    vehicle, parameters = faulty_vehicle(fleet)
    drive = tmp_path / "drive.log"
    write_start_of_unseen_drive(fleet, vehicle, drive)
    with start_node(fleet.parent / "result" / "params" / f"{vehicle}.json", "--vehicle", vehicle) as node:
        play(drive)
        played = Counter(frame.identifier for frame in frames_of(drive))
        for name in ("battery", "motor"):
            branch = parameters.branches[name]
            sensor = replace(BRANCHES[name], drift=repr(branch.drift), offset_a=repr(branch.offset_a))
            message, signal = sensor.message, sensor.signal
            identifier = database.message(message).frame_id
            measured = recording.wait_for(identifier, played[f"{identifier:03X}"])
            corrected = recording.wait_for(database.message(f"{message}Corrected").frame_id, len(measured))
            quality = Quality.CORRECTED if branch.drift or branch.offset_a else Quality.PASSED_THROUGH
            for before, after in zip(measured, corrected, strict=True):
                code = int.from_bytes(before[2:4], "little", signed=True)
                decoded = database.message(f"{message}Corrected").decode_simple(
                    after, scaling=False, decode_choices=False
                )
                assert decoded[f"{signal}Corrected"] == sensor.corrected_code(code)
                assert decoded[f"{signal}Quality"] == quality
        assert node.stop() == 0
    figures = compare(recording.log)
    assert figures["before"]["sum"]["rmse_a"] >= 10.0 * figures["after"]["sum"]["rmse_a"], msgspec.json.encode(figures)


def compare(log: Path) -> dict[str, dict[str, dict[str, float]]]:
    """What `calibrator kirchhoff` says of a log."""
    command = [sys.executable, "-m", "calibrator", "kirchhoff", str(log), "--layout", str(LAYOUT), "--json"]
    done = subprocess.run(command, check=True, capture_output=True, timeout=120)
    result: dict[str, dict[str, dict[str, float]]] = json.loads(done.stdout)
    return result
