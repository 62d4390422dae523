from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrator.artificial.trips import (
    BuiltinTrips,
    GroundTruth,
    RecordedTrips,
    TripSource,
    choose_trips,
)
from calibrator.drive import Channel, Drive
from calibrator.drives.store import write_drive
from calibrator.errors import FleetError
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout


def recorded(name: str, level: float) -> GroundTruth:
    speed = np.where(np.arange(600) % 60 < 10, 0.0, 30.0)
    battery = np.full(600, level)
    return GroundTruth(
        name=name, period_s=0.1, currents_a={"battery": battery, "motor": -battery}, inputs={"speed": speed}
    )


TRIPS = [recorded(f"trip{k}", float(k)) for k in range(4)]


def levels(trip: GroundTruth) -> set[float]:
    return set(trip.currents_a["battery"].tolist())


def test_each_vehicle_has_a_recorded_trip_of_its_own_while_they_last() -> None:
    trips = RecordedTrips(seed=0, recorded=TRIPS, vehicles=4, unseen_s=20.0)
    assert [levels(trips.trip(k, "calibration")) for k in range(4)] == [{0.0}, {1.0}, {2.0}, {3.0}]


def test_unseen_trip_holds_nothing_of_the_vehicles_own() -> None:
    trips = RecordedTrips(seed=0, recorded=TRIPS, vehicles=4, unseen_s=30.0)
    for k in range(4):
        unseen = trips.trip(k, "unseen")
        assert len(unseen) == 300
        assert float(k) not in levels(unseen)


def test_larger_fleets_learn_from_some_recordings_and_are_tested_on_the_others() -> None:
    trips = RecordedTrips(seed=0, recorded=TRIPS, vehicles=9, unseen_s=30.0)
    for k in range(9):
        assert levels(trips.trip(k, "calibration")) <= {0.0, 1.0}
        assert levels(trips.trip(k, "unseen")) <= {2.0, 3.0}


def test_single_recording_is_cut_in_time() -> None:
    ramp = np.arange(600.0)
    inputs = recorded("only", 0.0).inputs
    only = GroundTruth(name="only", period_s=0.1, currents_a={"battery": ramp, "motor": -ramp}, inputs=inputs)
    for vehicles in (1, 3):
        trips = RecordedTrips(seed=0, recorded=[only], vehicles=vehicles, unseen_s=10.0)
        assert levels(trips.trip(0, "calibration")).isdisjoint(levels(trips.trip(0, "unseen")))


def test_common_trips_are_the_same_for_all_and_differ_by_purpose() -> None:
    trips = BuiltinTrips(seed=0, duration_s=60.0, unseen_s=60.0, common=True)
    first, second = trips.trip(0, "calibration"), trips.trip(5, "calibration")
    np.testing.assert_array_equal(first.currents_a["battery"], second.currents_a["battery"])
    unseen = trips.trip(0, "unseen")
    assert len(unseen) != len(first) or not np.array_equal(unseen.inputs["speed"], first.inputs["speed"])


def channel(good: bool) -> Channel:
    return Channel(time_s=np.arange(100) * 0.1, value=np.ones(100), good=np.full(100, good))


def test_drives_without_good_samples_are_left_out_by_name(database: VehicleDatabase, tmp_path: Path) -> None:
    for name, good in (("fine", True), ("stuck", False)):
        branches = {"battery": channel(True), "motor": channel(good)}
        write_drive(tmp_path, Drive(vehicle=name, name="d", branches=branches, inputs={}), database.layout)
    trips = choose_trips(str(tmp_path), database.layout, vehicles=1, seed=0, duration_s=5.0, unseen_s=5.0, common=False)
    assert trips.branches == ("battery", "motor")
    assert "stuck/d" in trips.notices[0]
    assert "fine/d" not in trips.notices[0]


def builtin(layout: Layout) -> TripSource:
    return choose_trips("builtin", layout, vehicles=1, seed=0, duration_s=5.0, unseen_s=5.0, common=False)


def renamed(layout: Layout, *, branches: bool = False, inputs: Sequence[str] = ()) -> Layout:
    """The layout with its branches, and the derived inputs that read some inputs, under other names."""
    branch = [msgspec.structs.replace(b, name=f"my_{b.name}") if branches else b for b in layout.branch]
    derived = layout.derived
    for name in inputs:
        derived = [msgspec.structs.replace(d, formula=d.formula.replace(name, f"my_{name}")) for d in derived]
    return msgspec.structs.replace(layout, branch=branch, derived=derived)


def test_layout_with_other_branches_is_told_those_of_the_builtin_vehicle(database: VehicleDatabase) -> None:
    with pytest.raises(FleetError, match=r"two or more branches named battery, motor, .* or give --drives a store"):
        builtin(renamed(database.layout, branches=True))


def test_inputs_that_the_builtin_vehicle_has_not_are_named(database: VehicleDatabase) -> None:
    (notice,) = builtin(renamed(database.layout, inputs=["heater_demand"])).notices
    assert notice == "model inputs that the built-in vehicle has not: heater_current"
