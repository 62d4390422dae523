"""Whole runs as a user types them: killed and gone on with, with any number of workers, on a cluster, from a result."""

import dataclasses
import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from calibrator.calibration.unfinished import unfinished_run
from calibrator.errors import FleetError
from calibrator.results.rows import read_results
from calibrator.results.run_record import read_run
from calibrator.summaries.store import SummaryStore
from ecu_node.database import VehicleDatabase
from tests.calibrator.calibration.test_run_passes import faults_of_vehicle
from tests.calibrator.command_here import calibrator
from tests.calibrator.evidence.simulated_drives import Conditions, summaries_of
from tests.calibrator.summaries.small_stores import random_faults, record_of, small_store

LAYOUT = Path(__file__).parents[3] / "dbc" / "hv_powertrain.toml"
VEHICLES = 60
ENVIRONMENT = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000", "OMP_NUM_THREADS": "1"}


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "calibrator", *map(str, arguments)]


def calibrate(store: str, out: Path, *options: object) -> subprocess.CompletedProcess[str]:
    line = command("calibrate", store, "--layout", LAYOUT, "--out", out, *options)
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=300, env=ENVIRONMENT)


def refused(store: str, out: Path, *options: object) -> subprocess.CompletedProcess[str]:
    return calibrator("calibrate", store, "--layout", LAYOUT, "--out", out, *options)


def contents(result: Path) -> dict[str, bytes]:
    return {str(path.relative_to(result)): path.read_bytes() for path in sorted(result.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def store(database: VehicleDatabase, tmp_path_factory: pytest.TempPathFactory) -> SummaryStore:
    return small_store(tmp_path_factory.mktemp("fleet") / "store", database, random_faults(VEHICLES))


@pytest.fixture(scope="module")
def result(store: SummaryStore) -> Path:
    out = Path(store.url).parent / "result"
    run = calibrate(store.url, out, "--workers", 1)
    assert run.returncode == 0, run.stderr
    return out


def test_a_result_has_every_vehicle_once_in_order(result: Path) -> None:
    rows = read_results(result)
    assert [row["vehicle"] for row in rows[::2]] == [f"V{j:03d}" for j in range(VEHICLES)]
    assert sorted(path.stem for path in (result / "params").iterdir()) == [f"V{j:03d}" for j in range(VEHICLES)]
    assert read_run(result).vehicles == VEHICLES
    assert not (result.parent / ".result.unfinished").exists()


def test_the_result_is_the_same_for_any_number_of_workers(store: SummaryStore, result: Path, tmp_path: Path) -> None:
    run = calibrate(store.url, tmp_path / "two", "--workers", 2)
    assert run.returncode == 0, run.stderr
    assert contents(tmp_path / "two") == contents(result)


def test_a_run_that_is_killed_goes_on_where_it_stopped(store: SummaryStore, result: Path, tmp_path: Path) -> None:
    out, chunks = tmp_path / "out", tmp_path / ".out.unfinished" / "chunks"
    line = command("calibrate", store.url, "--layout", LAYOUT, "--out", out, "--workers", 1)
    written: dict[str, int] = {}
    for wanted in (1, 4, 9):
        with subprocess.Popen(line, stderr=subprocess.PIPE, env=ENVIRONMENT) as run:
            until = time.monotonic() + 120.0
            while len(list(chunks.glob("*.rows.parquet"))) < wanted and time.monotonic() < until:
                time.sleep(0.002)
            run.send_signal(signal.SIGKILL)
        found = {path.name: path.stat().st_mtime_ns for path in chunks.glob("*.rows.parquet")}
        assert len(found) >= wanted
        assert written.items() <= found.items(), "chunks that are done are not made again"
        assert not out.exists()
        written = found
    run_on = calibrate(store.url, out, "--workers", 1)
    assert run_on.returncode == 0, run_on.stderr
    assert contents(out) == contents(result)


def test_other_settings_do_not_go_on_from_what_was_computed(store: SummaryStore, result: Path, tmp_path: Path) -> None:
    unfinished = tmp_path / ".out.unfinished"
    (unfinished / "chunks").mkdir(parents=True)
    (unfinished / "plan").write_text("another plan\n1999")
    (unfinished / "chunks" / "00000.rows.parquet").write_bytes(b"nonsense")
    run = calibrate(store.url, tmp_path / "out", "--workers", 1)
    assert run.returncode == 0, run.stderr
    assert contents(tmp_path / "out") == contents(result)


def test_a_second_run_to_the_same_place_is_refused(store: SummaryStore, tmp_path: Path) -> None:
    with unfinished_run(tmp_path / "out"):
        second = calibrate(store.url, tmp_path / "out", "--workers", 1)
    assert second.returncode == 1
    assert "another run is writing this result; wait for it or choose another --out" in second.stderr


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--method", "published"), 1, "a store of summaries, and --method published needs the drives"),
        (("--sensor-models",), 1, "a store of summaries, and --sensor-models needs the drives"),
        (("--branches", "battery,motor"), 1, "a store of summaries, and --branches needs the drives"),
        (("--trusted", "V777"), 1, "fleet small: no usable vehicle V777 to trust"),
        (("--hold-out", "V777"), 1, "fleet small: no usable vehicle V777 to hold out"),
        (
            ("--trusted", ",".join(f"V{number}" for number in range(700, 710))),
            1,
            "V700, V701, V702, V703, V704, V705 and 4 more to trust",
        ),
        (("--hold-out", "V003", "--trusted", "V003"), 2, "vehicle V003 is both held out and trusted"),
        (("--since", "earlier", "--branches", "battery,motor"), 2, "--branches and --since exclude each other"),
        (("--since", "earlier", "--sensor-models"), 2, "--sensor-models and --since exclude each other"),
        (("--scheduler", "tcp://127.0.0.1:9"), 1, "tcp://127.0.0.1:9: no Dask scheduler answers"),
        (("--scheduler", ""), 2, "'': expected the address of a Dask scheduler, tcp://HOST:PORT or tls://HOST:PORT"),
        (("--scheduler", "http://127.0.0.1:9"), 2, "'http://127.0.0.1:9': expected the address of a Dask scheduler"),
        (("--scheduler", "tcp://127.0.0.1:99999"), 2, "port 1 to 65535"),
    ],
)
def test_what_summaries_do_not_tell_is_refused_in_one_line(
    store: SummaryStore, tmp_path: Path, options: tuple[str, ...], code: int, message: str
) -> None:
    run = refused(store.url, tmp_path / "out", *options)
    assert run.returncode == code
    assert message in run.stderr.splitlines()[-1]
    assert "Traceback" not in run.stderr
    assert list(tmp_path.iterdir()) == [], "nothing was computed, so nothing is left"


def test_since_an_earlier_result_only_those_who_drove_are_calibrated(
    store: SummaryStore, result: Path, database: VehicleDatabase, tmp_path: Path
) -> None:
    shutil.copytree(store.url, tmp_path / "store")
    grown = SummaryStore(storage=type(store.storage)(url=str(tmp_path / "store")), identity=store.identity)
    bucket = grown.bucket_of("V009")
    records = grown.read(bucket)
    (new,) = summaries_of(faults_of_vehicle(9, drift=0.08), Conditions(model_error_a=0.5), seed=5)
    grown.write(bucket, {**records, "V009": [*records["V009"], record_of("V009", new, ("d2",))]})
    run = calibrate(grown.url, tmp_path / "out", "--since", result, "--workers", 1)
    assert run.returncode == 0, run.stderr
    assert "moved since the earlier result:" in run.stdout
    assert "V009: battery drift" in run.stdout
    before, after = contents(result / "params"), contents(tmp_path / "out" / "params")
    assert [name for name in before if before[name] != after[name]] == ["V009.json"]


def test_a_vehicle_that_cannot_be_used_stops_neither_pass(
    store: SummaryStore, database: VehicleDatabase, tmp_path: Path
) -> None:
    shutil.copytree(store.url, tmp_path / "store")
    other = SummaryStore(storage=type(store.storage)(url=str(tmp_path / "store")), identity=store.identity)
    bucket = other.bucket_of("V012")
    records = other.read(bucket)
    found = records["V012"][0].found
    assert found is not None
    huge = dataclasses.replace(found.summary, moments=1e200 * found.summary.moments)
    spoilt = dataclasses.replace(records["V012"][0], found=dataclasses.replace(found, summary=huge))
    other.write(bucket, {**records, "V012": [spoilt]})
    run = calibrate(other.url, tmp_path / "out", "--workers", 2)
    assert run.returncode == 0, run.stderr
    assert read_run(tmp_path / "out").left_out == {
        "V012": "its summary holds impossible numbers; look at its recordings, and summarise them again"
    }
    assert read_run(tmp_path / "out").vehicles == VEHICLES - 1


def test_since_a_result_without_its_parameters_is_refused(store: SummaryStore, result: Path, tmp_path: Path) -> None:
    shutil.copytree(result, tmp_path / "earlier")
    shutil.rmtree(tmp_path / "earlier" / "parameters")
    run = refused(store.url, tmp_path / "out", "--since", tmp_path / "earlier")
    assert run.returncode == 1
    assert "earlier/parameters: no such folder; expected the parameters of the earlier result: give" in run.stderr
    assert not (tmp_path / ".out.unfinished").exists()


def test_a_place_that_is_no_fleet_is_told_in_words(store: SummaryStore, tmp_path: Path) -> None:
    shutil.copytree(store.url, tmp_path / "both")
    (tmp_path / "both" / "drives").mkdir()
    shutil.copytree(store.url, tmp_path / "empty", ignore=shutil.ignore_patterns("*.parquet"))
    (tmp_path / "file").touch()
    for place, code, message in (
        ("nothing", 1, "nothing: no such folder, store of drives or store of summaries"),
        ("file", 1, "file: is a file; give a store of drives or of summaries, or a folder with one folder of logs"),
        ("both", 1, "both: holds drives (drives) and summaries (summaries.json); move one of them elsewhere"),
        ("empty", 1, "empty: the store of summaries is empty; add drives with 'calibrator summarise'"),
    ):
        run = refused(str(tmp_path / place), tmp_path / "out")
        assert (run.returncode, message in run.stderr.splitlines()[-1]) == (code, True), run.stderr
        assert not (tmp_path / ".out.unfinished").exists()
    for place, code, message in (("", 2, "an empty name; give the path"), ("file://", 1, "'file://': names no place")):
        run = refused(place, tmp_path / "out")
        assert (run.returncode, message in run.stderr.splitlines()[-1]) == (code, True), run.stderr


def test_drives_are_not_summarised_into_a_folder_that_holds_something_else(result: Path, tmp_path: Path) -> None:
    (tmp_path / "fleet").mkdir()
    for out, code, message in (
        (result, 1, "no store of summaries, and not empty: parameters, params, results.parquet, run.json; choose"),
        (result / "run.json", 1, "run.json: is a file; name a folder"),
        ("memory://m", 1, "memory://m: is gone when the command ends"),
        ("", 2, "an empty name; give the path of a folder"),
    ):
        run = calibrator("summarise", tmp_path / "fleet", "--layout", LAYOUT, "--out", out)
        assert (run.returncode, message in run.stderr.splitlines()[-1]) == (code, True), run.stderr
    run = calibrator("summarise", "", "--layout", LAYOUT, "--out", "x")
    assert (run.returncode, "an empty name" in run.stderr) == (2, True)


def test_what_was_computed_is_kept_and_else_nothing(store: SummaryStore, tmp_path: Path) -> None:
    out, folder = tmp_path / "out", tmp_path / ".out.unfinished"
    for name, kept in (("chunks/00003.rows.parquet", True), ("summaries/buckets/00003.parquet", True), ("plan", False)):
        with suppress(FleetError), unfinished_run(out):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).touch()
            raise FleetError("a slip")
        assert folder.exists() == kept
        shutil.rmtree(folder, ignore_errors=True)
    (tmp_path / "earlier").mkdir()
    (tmp_path / "earlier" / "run.json").touch()
    shutil.copytree(store.url, tmp_path / "earlier" / "summaries")
    for new in (False, True):
        with suppress(FleetError), unfinished_run(out) as unfinished:
            unfinished.summaries_since(tmp_path / "earlier")
            if new:
                (unfinished.summaries / "buckets" / "00003.parquet").touch()
            raise FleetError("a slip")
        assert folder.exists() == new, "copies of earlier summaries are nothing new"


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "Error writing bytes to file. Detail: [errno 28] No space left on device"),
        shutil.Error([("a", "b", "[Errno 28] No space left on device: 'b'")]),
    ],
)
def test_a_full_disk_is_told_with_what_to_do(tmp_path: Path, error: OSError) -> None:
    where = "b" if isinstance(error, shutil.Error) else rf"{tmp_path}/\.out\.unfinished"
    message = rf"^{where}: cannot write it: .*No space left on device.*; make room, and run the same command again"
    with pytest.raises(FleetError, match=message), unfinished_run(tmp_path / "out"):
        raise error


def test_since_what_is_no_result_is_refused(store: SummaryStore, tmp_path: Path) -> None:
    run = refused(store.url, tmp_path / "out", "--since", tmp_path / "nothing")
    assert run.returncode == 1
    assert "not a result of 'calibrator calibrate'" in run.stderr
    assert "Traceback" not in run.stderr
