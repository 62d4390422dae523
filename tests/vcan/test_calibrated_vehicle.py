"""From a fleet's logs to corrected frames on a real bus: the calibrator's own parameters, on an unseen drive."""

import gzip
import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from ecu_node.parameters import read_parameters
from tests.vcan.calibrated_fleet import make_calibrated_fleet
from tests.vcan.conftest import StartNode
from tests.vcan.patient_layout import LAYOUT
from tests.vcan.processes import Recording, frames_of, play

SECONDS = 8.0


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a fleet, with its result beside it; made here unless HV_CALIBRATED_FLEET names one made before."""
    made = os.environ.get("HV_CALIBRATED_FLEET")
    folder = Path(made) if made else tmp_path_factory.mktemp("calibrated")
    if not made:
        make_calibrated_fleet(folder)
    return folder / "fleet"


def test_sum_of_an_unseen_drive_is_a_tenth(fleet: Path, tmp_path: Path, start_node: StartNode, here: Recording) -> None:
    files = sorted((fleet.parent / "result" / "params").glob("*.json"))
    params = next(path for path in files if read_parameters(path).verdict == "corrected")
    unseen = gzip.decompress((fleet / "unseen" / params.stem / "drive.log.gz").read_bytes()).decode().splitlines()
    start = [line for line in unseen if float(line[1 : line.index(")")]) < SECONDS]
    (tmp_path / "drive.log").write_text("\n".join(start) + "\n")
    with start_node("--vehicle", params.stem, params=params) as node:
        play(tmp_path / "drive.log")
        played = Counter(frame.identifier for frame in frames_of(tmp_path / "drive.log"))
        for measured, corrected in (("110", 0x510), ("120", 0x520)):
            here.wait_for(corrected, played[measured])
        assert node.stop() == 0
    command = [sys.executable, "-m", "calibrator", "kirchhoff", str(here.log), "--layout", str(LAYOUT), "--json"]
    figures = json.loads(subprocess.run(command, check=True, capture_output=True, timeout=120).stdout)
    assert figures["before"]["sum"]["rmse_a"] >= 10.0 * figures["after"]["sum"]["rmse_a"], figures
