import gzip
import os
import subprocess
import sys
from pathlib import Path

from calibrator.processes.run_many import Workers
from calibrator.sources.import_logs import ImportReport, import_logs
from ecu_node.database import VehicleDatabase
from tests.calibrator.conftest import LAYOUT


def imported(logs: list[Path], store: Path, database: VehicleDatabase) -> ImportReport:
    return import_logs(logs, database, store, workers=Workers())


def test_import_adds_only_logs_the_store_lacks(two_vehicles: Path, tmp_path: Path, database: VehicleDatabase) -> None:
    first = imported([two_vehicles / "logs" / "V001"], tmp_path, database)
    both = imported([two_vehicles], tmp_path, database)  # beside the logs it has unseen drives
    assert (len(first.drives), first.already_there) == (1, ())
    assert ([drive.vehicle for drive in both.drives], both.already_there) == (["V002"], ("V001/drive",))
    assert f"1 drive written to {tmp_path}, 1 already there, 0 left out" in both.as_text()


def test_damaged_drive_of_the_store_is_reported(two_vehicles: Path, tmp_path: Path, database: VehicleDatabase) -> None:
    imported([two_vehicles / "logs" / "V001"], tmp_path, database)
    (tmp_path / "drives" / "V001" / "drive.parquet").write_bytes(b"cut")
    report = imported([two_vehicles / "logs" / "V001"], tmp_path, database)
    assert report.already_there == ()
    assert "not a drive" in report.left_out["V001/drive"]
    assert "remove it and import it again" in report.left_out["V001/drive"]


def test_leftover_of_a_killed_import_is_removed(two_vehicles: Path, tmp_path: Path, database: VehicleDatabase) -> None:
    folder = tmp_path / "drives" / "V001"
    folder.mkdir(parents=True)
    left, other = folder / ".drive.parquet.x1y2", folder / ".drive.parquet.new"
    left.write_bytes(b"half")
    os.utime(left, (0, 0))
    other.write_bytes(b"half")  # of an import that runs at the same time
    os.utime(other, (2e9, 2e9))
    imported([two_vehicles / "logs" / "V001"], tmp_path, database)
    assert {path.name for path in folder.iterdir()} == {"drive.parquet", other.name}


def test_slow_log_is_left_out_and_others_are_read(
    two_vehicles: Path, tmp_path: Path, database: VehicleDatabase
) -> None:
    endless = tmp_path / "logs" / "V000" / "endless.log.gz"
    endless.parent.mkdir(parents=True)
    endless.write_bytes(gzip.compress(b"\n" * (1 << 24)) * 2000)  # blank lines: a small file, minutes to read
    logs = [endless, two_vehicles / "logs"]
    report = import_logs(logs, database, tmp_path / "store", workers=Workers(), limit_s=10.0)
    assert [drive.vehicle for drive in report.drives] == ["V001", "V002"]
    assert list(report.left_out) == ["V000/endless"]
    assert report.left_out["V000/endless"].startswith(f"{endless}: reading took more than 10 s and was ended; ")


def test_unwritable_drive_stops_the_import(two_vehicles: Path, tmp_path: Path, database: VehicleDatabase) -> None:
    """Otherwise all further drives would be left out one by one, with exit code 0."""
    command = [sys.executable, "-B", "-m", "calibrator", "import", str(two_vehicles / "logs"), "--layout", str(LAYOUT)]
    limited = ["prlimit", "--fsize=1000", *command, "--out", str(tmp_path)]
    unmeasured = {name: value for name, value in os.environ.items() if not name.startswith("COV")}
    found = subprocess.run(limited, env=unmeasured, capture_output=True, text=True, check=False)
    assert found.returncode == 1
    assert "drive.parquet: cannot write it: File too large; " in found.stderr.splitlines()[-1]
    assert len(imported([two_vehicles / "logs"], tmp_path, database).drives) == 2
