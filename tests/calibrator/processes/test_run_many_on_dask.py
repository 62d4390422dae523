"""run_many on a Dask cluster with two workers: results, lost workers, a scheduler that is restarted, object storage."""

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from threading import Thread, Timer

import pytest

from calibrator.artificial.simulate import FleetPlan, simulate_fleet
from calibrator.artificial.trips import BuiltinTrips
from calibrator.errors import FleetError
from calibrator.files.storage import Storage, open_storage, walk
from calibrator.processes import run_many as module
from calibrator.processes.run_many import Workers, run_many
from calibrator.summaries.summary_store import existing_store
from ecu_node.database import VehicleDatabase
from tests.calibrator.conftest import LAYOUT
from tests.calibrator.processes.dask_cluster import DaskCluster, gated, of_no_disk
from tests.calibrator.processes.test_run_many import require_failing_items_affect_no_others

distributed = pytest.importorskip("distributed")
PLAN = FleetPlan(vehicles=6, currents=2, sparsity=80.0, magnitude=(0.05, 0.25))


@pytest.fixture(scope="module")
def where(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workers]:
    """A cluster whose workers no test ends."""
    with DaskCluster(tmp_path_factory.mktemp("cluster")) as cluster:
        yield Workers(scheduler=cluster.address)
        assert all(worker.poll() is None for worker in cluster.workers)


def test_failing_or_crashing_items_do_not_affect_others_on_dask(tmp_path: Path, where: Workers) -> None:
    # a worker of Dask may not know the signal
    require_failing_items_affect_no_others(where, tmp_path, knows_signals=False)


def test_error_of_an_item_is_not_taken_for_a_lost_scheduler(where: Workers, monkeypatch: pytest.MonkeyPatch) -> None:
    def items() -> Iterator[int]:
        yield from range(2, 60)
        raise OSError("no more")

    results = run_many(of_no_disk, range(3), where)
    assert next(results) == 0
    with pytest.raises(OSError, match="no disk"):
        next(results)
    with pytest.raises(OSError, match="no more"):
        list(run_many(of_no_disk, items(), where))
    monkeypatch.setattr(module, "__version__", "0")
    with pytest.raises(FleetError, match=r"a worker of the cluster has version .*; install version 0 there"):
        list(run_many(abs, range(3), where))


@pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")  # distributed's, to a scheduler that was killed
def test_run_goes_on_after_the_scheduler_was_restarted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_S", 2.0)
    monkeypatch.setattr(module, "COUNT_EVERY_S", 0.01)  # so that workers are counted while there is no scheduler
    with DaskCluster(tmp_path) as cluster:
        results = run_many(partial(gated, folder=tmp_path), range(20), Workers(scheduler=cluster.address))
        assert [next(results), next(results)] == [0, 1]
        for process in (cluster.scheduler, *cluster.workers):
            process.send_signal(signal.SIGKILL)
            process.wait()
        while any(
            client.scheduler is not None for client in distributed.Client._instances
        ):  # until the client has noticed it
            time.sleep(0.05)
        cluster.start()
        (tmp_path / "go").touch()
        assert list(results) == list(range(2, 20))
        (tmp_path / "go").unlink()
        results = run_many(partial(gated, folder=tmp_path), range(20), Workers(scheduler=cluster.address))
        next(results)
        monkeypatch.setattr(module, "RETURN_S", 1.0)
        cluster.scheduler.kill()
        with pytest.raises(FleetError, match=r"the scheduler is gone; start it .*, and run the same command again"):
            list(results)


@pytest.mark.parametrize("is_fetching", [False, True])
def test_loss_of_all_workers_ends_the_run_with_an_error_that_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], is_fetching: bool
) -> None:
    """Such as workers without this package; Dask itself waits forever for results that were lost with their worker."""
    monkeypatch.setattr(module, "CONNECT_S", 2.0)
    monkeypatch.setattr(module, "RETURN_S", 2.0)
    with DaskCluster(tmp_path) as cluster:

        def end_workers() -> None:
            for worker in cluster.workers:
                worker.kill()

        results = run_many(partial(gated, folder=tmp_path), range(1, 20), Workers(scheduler=cluster.address))
        assert next(results) == 1
        if is_fetching:
            (tmp_path / "go").touch()
            time.sleep(0.5)  # some are ready now, on workers that do not answer any more
            for worker in cluster.workers:
                worker.send_signal(signal.SIGSTOP)
        end = Timer(0.5, end_workers)
        end.start()
        with pytest.raises(FleetError, match=r"no worker; start .* with this package .*, and run the same command"):
            list(results)
        end.join()
    assert "the scheduler has no worker now; waiting 2 s for one" in capsys.readouterr().err


def test_server_that_is_not_a_dask_scheduler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_S", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def greet() -> None:
            with server.accept()[0] as connection:
                connection.sendall(b"SSH-2.0-OpenSSH")
                with suppress(ConnectionResetError):
                    connection.recv(1)  # until it is closed

        Thread(target=greet, daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(FleetError, match=r"no Dask scheduler answers: another kind of server.*; start one"):
            list(run_many(abs, range(3), Workers(scheduler=address)))


@pytest.fixture(scope="module")
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Environment in which S3 is a server of this machine, with a bucket."""
    server_module = pytest.importorskip("moto.server")
    boto3 = pytest.importorskip("boto3")
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    environment = dict.fromkeys(("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), "testing")
    environment |= {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_DEFAULT_REGION": "us-east-1"}
    environment["SOURCE_DATE_EPOCH"] = "1700000000"
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        with closing(boto3.client("s3")) as client:
            client.create_bucket(Bucket="fleet")
        yield environment
    server.stop()


def command(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own, which takes its sockets of cluster and storage with it."""
    line = [sys.executable, "-m", "calibrator", *map(str, arguments)]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return done


def summaries(place: str) -> dict[str, list[object]]:
    """Contents of a store without the versions of its files, which differ between storages."""
    store = existing_store(place)
    return {
        name: [(r.drives, r.digests, r.found and r.found.summary.moments.tobytes(), r.problem) for r in records]
        for bucket in store.buckets()
        for name, records in store.read(bucket).items()
    }


def drives(place: str) -> dict[str, bytes]:
    return {
        f"{folder.url.rpartition('/')[2]}/{file.name}": folder.read(file.name)
        for folder, files in walk(open_storage(place), [])
        for file in files
    }


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory, database: VehicleDatabase, s3: dict[str, str]) -> Path:
    """Logs of a fleet, which lie at s3://fleet/logs as well."""
    out = tmp_path_factory.mktemp("fleet")
    simulate_fleet(PLAN, BuiltinTrips(seed=0, duration_s=130.0, unseen_s=10.0), database, out, workers=1)
    for folder, files in walk(open_storage(out / "logs"), []):
        for file in files:
            there = Storage(url=f"s3://fleet/{folder.url.removeprefix(f'{out}/')}")
            there.write(file.name, folder.read(file.name))
    return out / "logs"


def test_drives_in_object_storage_equal_those_in_a_folder(logs: Path, tmp_path: Path) -> None:
    for source, out in ((logs, tmp_path / "here"), ("s3://fleet/logs", "s3://fleet/here")):
        command("import", source, "--layout", LAYOUT, "--out", out)
    assert drives("s3://fleet/here/drives") == drives(str(tmp_path / "here" / "drives"))


@pytest.mark.long
def test_cluster_and_object_storage_give_the_results_of_files(logs: Path, tmp_path: Path, s3: dict[str, str]) -> None:
    layout = ("--layout", LAYOUT)
    for processes in (1, 2):
        command("summarise", logs, *layout, "--out", tmp_path / f"s{processes}", "--workers", processes)
    command("calibrate", tmp_path / "s1", *layout, "--out", tmp_path / "here")
    with DaskCluster(tmp_path, s3) as cluster:
        there = ("--scheduler", cluster.address)
        command("import", "s3://fleet/logs", *layout, "--out", "s3://fleet/there", *there)
        command("import", logs, *layout, "--out", tmp_path / "drives")
        assert drives("s3://fleet/there/drives") == drives(str(tmp_path / "drives" / "drives"))
        command("summarise", logs, *layout, "--out", tmp_path / "dask", *there)
        reading = ("summarise", "s3://fleet/logs", *layout, "--out", "s3://fleet/s", "--json")
        report = json.loads(command(*reading, *there).stdout)
        assert (report["vehicles"], report["drives"], report["left_out"]) == (6, 6, {})
        assert json.loads(command(*reading).stdout)["drives"] == 0  # they are known
        expected = summaries(str(tmp_path / "s1"))
        for place in (str(tmp_path / "s2"), str(tmp_path / "dask"), "s3://fleet/s"):
            assert summaries(place) == expected
        command("calibrate", "s3://fleet/s", *layout, "--out", tmp_path / "there", *there)
    for path in sorted((tmp_path / "here" / "params").iterdir()):
        assert (tmp_path / "there" / "params" / path.name).read_bytes() == path.read_bytes()
    assert "6 vehicles" in command("store", "info", "s3://fleet/s").stdout
