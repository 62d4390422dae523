"""``python -m tests.vcan.calibrated_fleet DIR``: a small fleet of two branches, calibrated.

On user-mode-linux this takes minutes; ``make test`` makes it beforehand and names the folder in HV_CALIBRATED_FLEET.
"""

import shutil
import subprocess
import sys
from pathlib import Path

from tests.vcan.patient_layout import write_patient_layout


def make_calibrated_fleet(folder: Path) -> None:
    """Write layout, drives (``fleet``) and result into a folder, which is emptied before."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    layout, fleet = write_patient_layout(folder), folder / "fleet"
    calibrator(
        *("simulate", "--vehicles", 12, "--sparsity", 80, "--common-drive", "--symmetric", "--balanced"),
        *("--minutes", 3, "--unseen-minutes", 1, "--seed", 5, "--layout", layout, "--out", fleet, "--workers", 1),
    )
    calibrator("calibrate", fleet, "--layout", layout, "--out", folder / "result", "--workers", 1)


def calibrator(*arguments: object) -> None:
    """Run a command of the calibrator that must succeed."""
    subprocess.run([sys.executable, "-m", "calibrator", *map(str, arguments)], check=True, timeout=600)


if __name__ == "__main__":
    make_calibrated_fleet(Path(sys.argv[1]))
