"""Fleets of the experiments in memory, and ``simulate`` -> logs -> ``calibrate``: same vehicles, same result."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from calibrator.errors import FleetError
from calibrator.experiments.figures import judge
from calibrator.experiments.methods import POSTERIOR
from calibrator.experiments.recorded_trips import RecordedCase, read_fleet, recorded_trial
from calibrator.faults import Faults
from calibrator.score import recovered
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from tests.calibrator.command_here import succeeded
from tests.calibrator.conftest import LAYOUT
from tests.calibrator.experiments.small_trials import small_fleet, write_store

VEHICLES = 12


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_store(tmp_path_factory.mktemp("trips") / "store", small_fleet(VEHICLES).trips)


def test_trips_are_reduced_to_channels_common_to_all(tmp_path: Path) -> None:
    database, trips = read_database(read_layout(LAYOUT)), small_fleet(5, samples=1800).trips
    fleet = read_fleet(write_store(tmp_path / "some", trips, lacking=["motor", "speed"]), database)
    assert {frozenset(trip.currents_a) for trip in fleet.trips} == {frozenset({"battery", "auxiliary"})}
    assert {frozenset(trip.inputs) for trip in fleet.trips} == {frozenset({"voltage", "torque", "heater_demand"})}
    recorded_trial(fleet, RecordedCase(), 0).evidence  # noqa: B018  # their models have the same inputs
    with pytest.raises(FleetError, match=r"have none of its model inputs driving_current, .*; they have no inputs;"):
        read_fleet(write_store(tmp_path / "none", trips, lacking=[*trips[0].inputs]), database)


def calibrated(store: Path, out: Path) -> pd.DataFrame:
    """Result of the commands that users run, by vehicle and branch."""
    layout = ("--layout", LAYOUT, "--workers", 1)
    drawn = ("--vehicles", VEHICLES, "--drives", store, "--unseen-minutes", 0.1, "--balanced")
    succeeded("simulate", *layout, *drawn, "--out", out / "fleet")
    succeeded("calibrate", out / "fleet", *layout, "--out", out / "result")
    rows = pd.read_parquet(out / "result" / "results.parquet")
    return rows[rows["branch"].notna()].pivot_table(index="vehicle", columns="branch", aggfunc="first", sort=True)


def test_experiment_gives_the_same_estimate_as_simulate_and_calibrate(store: Path, tmp_path: Path) -> None:
    fleet, case = read_fleet(store, read_database(read_layout(LAYOUT))), RecordedCase()
    trial = recorded_trial(fleet, case, 0)
    estimate = POSTERIOR.estimate(trial)
    table = calibrated(store, tmp_path)
    branches = list(fleet.with_branches(2)[0].currents_a)

    def column(name: str) -> np.ndarray:
        return np.asarray(table[name][branches], dtype=float)

    found = Faults(
        hardware_drift=column("hardware_drift")[:, 0],
        hardware_offset_a=column("hardware_offset_a"),
        drift=column("drift"),
        offset_a=column("offset_a"),
    )
    # noise, frame times and quantisation differ between the two: decisions are equal, values nearly so
    within = judge(estimate, trial)["recovery_rate"]
    by_commands = recovered(found, trial.truth, full_scale_a=fleet.full_scale_a, smallest_fault=case.magnitude[0])
    np.testing.assert_array_equal(by_commands, within)
    np.testing.assert_array_equal(column("applied").astype(bool), estimate.corrected)
    both = estimate.corrected & within[:, None]
    np.testing.assert_allclose(found.drift[both], estimate.faults.drift[both], atol=0.01)
    np.testing.assert_allclose(found.offset_a[both], estimate.faults.offset_a[both], atol=0.01 * fleet.full_scale_a)
    assert within.mean() > 0.7
