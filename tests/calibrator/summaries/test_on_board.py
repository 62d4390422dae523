"""A node's own summary of a drive against that of its log, over a bus and through ``calibrator summarise``."""

import argparse
import time
from pathlib import Path

import can
import msgspec
import numpy as np
import pytest

from calibrator.drive import Array, Channel, Drive
from calibrator.recordings.log_formats import read_frames
from calibrator.summaries.summary_store import existing_store
from calibrator.summaries.vehicle_summary import VehicleSummary
from ecu_node.bus.on_board_summary import OnBoardSummary, on_board_summary
from ecu_node.database import VehicleDatabase
from ecu_node.errors import UserError
from ecu_node.parameters import BranchParameters
from ecu_node.summary import decode_summary
from tests.calibrator.command_here import reported, succeeded
from tests.calibrator.drive_logs import write_drive_log
from tests.ecu_node.vehicles import LAYOUT, parameters_for

MINUTES = 13.0
OPEN_S = 14.0
"""Time for which the contactors are open at the start. [s]"""
BATCH = 5
"""Number of blocks that the node adds up into one."""
OTHER_ID = 0x7A5
"""Identifier of frames that the layout does not name."""


def recorded_drive(seed: int = 1) -> Drive:
    """Some minutes with spikes, samples that are not good, and a gap."""
    rng = np.random.default_rng(seed)

    def channel(period_s: float, values: object) -> Channel:
        time_s = np.arange(0.0, 60.0 * MINUTES, period_s) + rng.uniform(0.0, 0.3 * period_s)
        value = np.asarray(values(time_s), np.float64)  # type: ignore[operator]
        return Channel(time_s=time_s, value=value, good=rng.random(len(time_s)) > 0.002)

    steps = 80.0 * rng.normal(size=1000)

    def current(time_s: Array) -> Array:
        flows = time_s > OPEN_S
        return np.asarray(flows * (steps[(time_s / 2.0).astype(int)] + 20.0 * np.sin(0.7 * time_s)))

    battery = channel(0.05, lambda t: current(t) + 5.0 + rng.normal(scale=0.5, size=len(t)))
    motor = channel(0.02, lambda t: -current(t) + rng.normal(scale=0.5, size=len(t)))
    auxiliary = channel(0.1, lambda t: -5.0 * (t > OPEN_S) + rng.normal(scale=0.2, size=len(t)))
    battery.value[2000:14000:1511] += 60.0
    motor.good[9000:10000] = False

    def beside_battery(value: Array) -> Channel:
        return Channel(time_s=battery.time_s, value=value, good=np.ones(len(value), bool))

    inputs = {
        "speed": channel(0.1, lambda t: 60.0 + 20.0 * np.sin(0.1 * t)),
        "torque": channel(0.05, lambda t: 0.5 * current(t)),
        "contactor_state": beside_battery(2.0 * (battery.time_s > OPEN_S)),
        "junction_box_temperature": beside_battery(np.round(20.0 + 0.01 * battery.time_s)),
        "voltage": beside_battery(350.0 - 0.05 * current(battery.time_s)),
    }
    branches = {"battery": battery, "motor": motor, "auxiliary": auxiliary}
    return Drive(vehicle="V1", name="drive", branches=branches, inputs=inputs)


def stored(place: Path) -> VehicleSummary:
    store = existing_store(place)
    (record,) = store.read(store.bucket_of("V1"))["V1"]
    assert record.found is not None, record.problem
    return record.found


def replay(log: Path, summary: OnBoardSummary, bus: can.BusABC) -> None:
    """Play a log with its own time stamps, each frame after one of :data:`OTHER_ID`; the node looks every 20 ms."""
    looked_s = 0.0
    for message in read_frames(log).messages():
        bus.send(can.Message(timestamp=message.timestamp, arbitration_id=OTHER_ID))
        bus.send(message)
        if message.timestamp - looked_s >= 0.02:
            looked_s = message.timestamp
            summary.look(looked_s)
    summary.look(looked_s)


def node_on(folder: Path, database: VehicleDatabase, delays: dict[str, float]) -> OnBoardSummary:
    parameters = parameters_for(database)
    branches = {
        name: BranchParameters(drift=0.0, offset_a=0.0, apply=False, delay_s=delay_s, delay_sd_s=0.001)
        for name, delay_s in delays.items()
    }
    options = argparse.Namespace(summary=folder, vehicle="V1")
    bus = {"interface": "virtual", "channel": "on_board", "fd": False, "listen_only": False}
    return on_board_summary(options, bus, database, msgspec.structs.replace(parameters, branches=branches), print)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, database: VehicleDatabase) -> Path:
    """Folder of a log, its summary (of_log), and the summary of a node that received it (vehicle)."""
    folder = tmp_path_factory.mktemp("on_board")
    log = folder / "logs" / "V1" / "drive.log.gz"
    write_drive_log(log, recorded_drive(), database)
    succeeded("summarise", folder / "logs", "--layout", LAYOUT, "--out", folder / "of_log", "--workers", 1)
    summary = node_on(folder / "vehicle", database, stored(folder / "of_log").delays.by_branch())
    with can.Bus(interface="virtual", channel="on_board", preserve_timestamps=True) as bus:
        replay(log, summary, bus)
        for _ in range(100):  # a thread writes
            written = [decode_summary(path.read_bytes()) for path in (folder / "vehicle" / "V1").glob("*.summary")]
            if [len(record.count) for record in written] == [5]:  # what a power cut leaves: all but the last batch
                break
            time.sleep(0.05)
        else:
            raise AssertionError("the batches are not written")
        summary.close()
    return folder


def test_summary_made_on_board_equals_that_of_the_log(folder: Path, tmp_path: Path) -> None:
    of_log = stored(folder / "of_log")
    size = sum(path.stat().st_size for path in (folder / "vehicle" / "V1").iterdir())
    assert size < 20_000 * MINUTES / 60.0 + 5000  # besides the levels, which are there once per file
    succeeded("summarise", folder / "vehicle", "--layout", LAYOUT, "--out", tmp_path)
    on_board = stored(tmp_path)
    full = of_log.summary.shortened(-(-len(of_log.summary.moments) // BATCH))
    size = np.sqrt(np.maximum(np.einsum("bii->bi", full.moments), 1e-9))
    scaled = (on_board.summary.moments - full.moments) / (size[:, :, None] * size[:, None, :])
    assert np.abs(scaled).max() < 1e-6
    np.testing.assert_allclose(on_board.summary.noise_a2, full.noise_a2, rtol=1e-5)
    ours, theirs = on_board.summary.fit, full.fit
    assert ours is not None
    assert theirs is not None
    for mine, its in ((ours.fast_a2, theirs.fast_a2), (ours.spikes, theirs.spikes)):
        np.testing.assert_allclose(mine, its, rtol=1e-5, atol=1e-5 * np.abs(its).max())
    np.testing.assert_allclose(ours.levels.sum(axis=1), theirs.levels.sum(axis=1), rtol=1e-5, atol=1e-3)
    assert np.abs(ours.levels - theirs.levels)[..., -2].sum() <= 6  # samples whose rounding decides on their level
    assert theirs.spikes.sum() >= 3
    assert ours.starts.tolist() == theirs.starts.tolist()
    np.testing.assert_allclose(ours.temperature_c, theirs.temperature_c, atol=0.02)  # a sample behind
    for name in ("offset_a", "sd_a"):
        reading = getattr(of_log.zero_current, name)
        assert np.isfinite(reading).all()
        np.testing.assert_allclose(getattr(on_board.zero_current, name), reading, rtol=1e-6)


def test_unusable_on_board_record_is_left_out(folder: Path, tmp_path: Path) -> None:
    (path,) = (folder / "vehicle" / "V1").iterdir()
    content = path.read_bytes()
    for vehicle, damaged in {"V1": content, "V2": content[:300], "V3": content, "V4": b"summary"}.items():
        (tmp_path / "vehicle" / vehicle).mkdir(parents=True)
        (tmp_path / "vehicle" / vehicle / "x.summary").write_bytes(damaged)
    report = reported("summarise", tmp_path / "vehicle", "--layout", LAYOUT, "--out", tmp_path / "store")
    left_out = report["left_out"]
    assert left_out.keys() == {"V2", "V3", "V4"}
    assert "damaged" in left_out["V2"]
    assert "a record of vehicle V1" in left_out["V3"]
    assert "damaged" in left_out["V4"]
    assert len(stored(tmp_path / "store").summary.moments) == 6


def test_on_board_summary_without_a_vehicle_name_is_refused(tmp_path: Path, database: VehicleDatabase) -> None:
    options = argparse.Namespace(summary=tmp_path, vehicle=None)
    with pytest.raises(UserError, match="--summary: it is not known which vehicle this is; give --vehicle"):
        on_board_summary(options, {}, database, None, print)
