"""The recorded trips of a BMW i3, as they are and with faults put into them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrator.drives.align import align, choose_inputs
from calibrator.drives.store import iterate_drives
from calibrator.experiments.figures import judge
from calibrator.experiments.methods import POSTERIOR
from calibrator.experiments.recorded_trips import RecordedCase, RecordedFleet, read_fleet, recorded_trial
from ecu_node.database import read_database
from ecu_node.layout import read_layout
from tests.real.conftest import LAYOUT

STUCK_HEATER = {"TripA03", "TripA05", "TripA06", "TripA13", "TripA18"}
"""Trips with a stuck heater signal, known from the energy balance.

TripA20, also said to be implausible, agrees with its energy balance except where the signal reads its default.
"""


@pytest.mark.long
def test_all_32_trips_are_imported_and_the_stuck_heaters_named(i3_notices: dict[str, list[str]]) -> None:
    assert len(i3_notices) == 32
    implausible = {name for name, texts in i3_notices.items() if any("implausible" in text for text in texts)}
    assert implausible == STUCK_HEATER
    assert all(any("default of 5.52 kW" in text for text in texts) for texts in i3_notices.values())


def test_trips_without_stuck_heater_have_valid_samples_that_sum_to_zero(i3_store: Path) -> None:
    layout = read_layout(LAYOUT)
    drives = [drive for drive in iterate_drives(i3_store, layout) if drive.name not in STUCK_HEATER]
    inputs, left_out = choose_inputs(layout, {name for drive in drives for name in drive.inputs})
    assert left_out == ("low_voltage_current",)
    for drive in drives:
        samples = align(drive, layout, ("battery", "motor", "auxiliary"), inputs=inputs)
        assert samples.valid.mean() > 0.7
        currents_a = samples.currents_a[samples.valid]
        np.testing.assert_allclose(currents_a.sum(axis=1), 0.0, atol=1e-9)
        assert np.all(currents_a[:, 2] <= 0.0)


@pytest.fixture(scope="module")
def trips(i3_store: Path) -> RecordedFleet:
    return read_fleet(i3_store, read_database(read_layout(LAYOUT)))


LONG = pytest.mark.long


@pytest.mark.parametrize(
    ("vehicles", "case", "least"),
    [
        (6, RecordedCase(branches=2, sparsity=80.0, balanced=True, world=""), 0.5),
        pytest.param(12, RecordedCase(branches=2, sparsity=80.0, balanced=True, world=""), 0.8, marks=LONG),
        (6, RecordedCase(branches=3, sparsity=80.0, balanced=True, world=""), 0.5),
        pytest.param(12, RecordedCase(branches=3, sparsity=80.0, balanced=True, world=""), 0.5, marks=LONG),
        pytest.param(None, RecordedCase(branches=3, sparsity=60.0, balanced=True, world=""), 0.01, marks=LONG),
        pytest.param(None, RecordedCase(branches=3, sparsity=60.0, balanced=False, world=""), 0.01, marks=LONG),
    ],
    ids=[
        *("6 vehicles, K=2, S=80", "12 vehicles, K=2, S=80", "6 vehicles, K=3, S=80", "12 vehicles, K=3, S=80"),
        *("all vehicles, K=3, S=60, balanced", "all vehicles, K=3, S=60"),
    ],
)
def test_enough_vehicles_with_faulty_sensors_are_corrected_and_none_is_harmed(
    trips: RecordedFleet, vehicles: int | None, case: RecordedCase, least: float
) -> None:
    """At least the share ``least`` of the vehicles with faulty sensors is corrected, and no corrected one gets worse.

    There are four fleets. Each has so many ``vehicles``, drawn from the trips; None: all trips.
    """
    found = []
    for seed in range(420, 424):
        some = np.random.default_rng(seed).permutation(len(trips.trips))[:vehicles]
        fleet = replace(trips, trips=tuple(trips.trips[place] for place in some))
        trial = recorded_trial(fleet, case, seed)
        found.append(judge(POSTERIOR.estimate(trial), trial))
    assert np.concatenate([each["deployed"] for each in found]).mean() >= least
    assert not np.concatenate([each["harmed"] for each in found]).any()
