"""Trips of the ideal vehicle: built in, recorded, or joined of pieces."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from calibrator.artificial import trips
from calibrator.artificial.builtin_drives import builtin_trip
from calibrator.artificial.random_fleet import FaultSettings, Purpose, random_stream
from calibrator.drive import Array, Channel, Drive
from calibrator.drives.store import write_drive
from calibrator.errors import FleetError
from calibrator.faults import Faults, measured_currents, true_currents
from ecu_node.database import VehicleDatabase
from ecu_node.layout import Layout


def recorded(level: float, rise: float = 0.0) -> trips.GroundTruth:
    """A minute at 10 Hz that starts and ends at a standstill."""
    speed = np.where((np.arange(600) + 5) % 60 < 10, 0.0, 30.0)
    battery, auxiliary = level + rise * np.arange(600.0), np.full(600, -2.0)
    currents = {"battery": battery, "motor": -battery - auxiliary, "auxiliary": auxiliary}
    return trips.GroundTruth(name=f"trip{level:g}", period_s=0.1, currents_a=currents, inputs={"speed": speed})


def levels(trip: trips.GroundTruth) -> set[float]:
    return set(trip.currents_a["battery"].tolist())


def test_rejoined_trip_has_jumps_only_at_standstills() -> None:
    joined = trips.cut_and_rejoin(np.random.default_rng(0), [recorded(0.0, rise=1.0)], duration_s=50.0, name="new")
    assert len(joined) >= 500
    jumps = np.flatnonzero(np.abs(np.diff(joined.currents_a["battery"])) > 1.0)
    assert jumps.size > 0
    assert np.all(joined.inputs["speed"][jumps] == 0.0)
    np.testing.assert_allclose(joined.matrix_a().sum(axis=1), 0.0, atol=1e-12)


def test_recorded_drive_becomes_a_trip_over_the_span_common_to_all_channels() -> None:
    def channel(start: float, good: np.ndarray) -> Channel:
        time_s = start + np.arange(100) * 0.1
        return Channel(time_s=time_s, value=np.where(good, 2.0 * time_s, 1e9), good=good)

    some, none = np.arange(100) != 50, np.zeros(100, bool)
    branches = {"battery": channel(0.0, some)}
    drive = Drive(vehicle="V", name="d", branches=branches, inputs={"speed": channel(0.5, some)})
    made = trips.ground_truth_from_drive(drive, 0.1)
    assert made is not None
    np.testing.assert_allclose(made.currents_a["battery"], 2.0 * (0.5 + made.time_s))
    assert len(made) == pytest.approx(94, abs=1)
    without_good = Drive(vehicle="V", name="d", branches=branches, inputs={"speed": channel(0.5, none)})
    assert trips.ground_truth_from_drive(without_good, 0.1) is None


def test_no_piece_of_a_recording_is_in_both_the_calibration_and_the_unseen_trip_of_a_vehicle() -> None:
    four = [recorded(float(k)) for k in range(4)]
    enough = trips.RecordedTrips(seed=0, recorded=four, vehicles=4, unseen_s=30.0)
    for k in range(4):
        assert levels(enough.trip(k, "calibration")) == {float(k)}
        unseen = enough.trip(k, "unseen")
        assert len(unseen) == 300
        assert float(k) not in levels(unseen)
    few = trips.RecordedTrips(seed=0, recorded=four, vehicles=9, unseen_s=30.0)
    for k in range(9):
        assert levels(few.trip(k, "calibration")) <= {0.0, 1.0}
        assert levels(few.trip(k, "unseen")) <= {2.0, 3.0}
    single = trips.RecordedTrips(seed=0, recorded=[recorded(0.0, rise=1.0)], vehicles=3, unseen_s=10.0)
    assert levels(single.trip(0, "calibration")).isdisjoint(levels(single.trip(0, "unseen")))


def test_builtin_trip_obeys_the_junction_law_and_has_all_channels(database: VehicleDatabase) -> None:
    trip = builtin_trip(np.random.default_rng(7), duration_s=300.0, name="trip")
    np.testing.assert_allclose(trip.matrix_a().sum(axis=1), 0.0, atol=1e-9)
    assert set(trip.currents_a) == set(database.layout.branch_names)
    not_modelled = {"contactor_state", "junction_box_temperature"}  # logs hold "not available" for them
    assert set(trip.inputs) == {item.name for item in database.layout.input} - not_modelled


def test_builtin_trip_without_fastsim_is_refused_with_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fastsim", None)  # makes its import fail
    with pytest.raises(FleetError, match=r"need fastsim; .*: pip install 'hv-current-correction\[demo\]'$"):
        builtin_trip(np.random.default_rng(0), duration_s=60.0, name="trip")


def chosen(drives: str, layout: Layout) -> trips.TripSource:
    return trips.choose_trips(drives, layout, vehicles=1, seed=0, duration_s=5.0, unseen_s=5.0, common=False)


def test_drives_without_good_samples_are_left_out_and_named(database: VehicleDatabase, tmp_path: Path) -> None:
    for name, good in (("fine", True), ("stuck", False)):
        branches = {
            branch: Channel(time_s=np.arange(100) * 0.1, value=np.ones(100), good=np.full(100, usable))
            for branch, usable in (("battery", True), ("motor", good))
        }
        write_drive(tmp_path, Drive(vehicle=name, name="d", branches=branches, inputs={}), database.layout)
    trips = chosen(str(tmp_path), database.layout)
    assert trips.branches == ("battery", "motor")
    assert trips.notices[0].endswith("left out: stuck/d")


def renamed(layout: Layout, *, branches: bool = False, inputs: Sequence[str] = ()) -> Layout:
    """The layout with its branches, and the derived inputs that read some inputs, under other names."""
    branch = [msgspec.structs.replace(b, name=f"my_{b.name}") if branches else b for b in layout.branch]
    derived = layout.derived
    for name in inputs:
        derived = [msgspec.structs.replace(d, formula=d.formula.replace(name, f"my_{name}")) for d in derived]
    return msgspec.structs.replace(layout, branch=branch, derived=derived)


def test_layout_without_builtin_branches_is_refused_and_missing_inputs_give_a_notice(database: VehicleDatabase) -> None:
    with pytest.raises(FleetError, match=r"two or more branches named battery, motor, .* or give --drives a store"):
        chosen("builtin", renamed(database.layout, branches=True))
    (notice,) = chosen("builtin", renamed(database.layout, inputs=["heater_demand"])).notices
    assert notice == "model inputs that the built-in vehicle has not: heater_current"


# Faults of a fleet


def draw(*, vehicles: int = 2000, branches: int = 2, **changes: Any) -> Faults:
    settings = replace(FaultSettings(sparsity=60.0), **changes)
    return settings.draw(np.random.default_rng(0), vehicles=vehicles, branches=branches, full_scale_a=400.0)


def free_parameters(faults: Faults) -> Array:
    """The 3K parameters of footnote 1, offsets in fractions of full scale."""
    hardware_offset, offset = faults.hardware_offset_a[:, :-1] / 400.0, faults.offset_a / 400.0
    return np.column_stack([faults.hardware_drift, hardware_offset, faults.drift, offset])


@pytest.mark.parametrize(("branches", "sparsity", "count"), [(3, 60.0, 4), (2, 60.0, 2), (5, 20.0, 12)])
def test_number_of_fault_parameters_follows_from_the_sparsity_level(branches: int, sparsity: float, count: int) -> None:
    faults = draw(branches=branches, sparsity=sparsity)
    assert np.all(np.count_nonzero(free_parameters(faults), axis=1) == count)


def test_mean_of_a_symmetric_fleet_is_the_ideal_current() -> None:
    faults = draw(symmetric=True, balanced=True, vehicles=400)
    i_s = np.array([[100.0, -100.0], [3.0, -3.0]])
    measured = [measured_currents(true_currents(i_s, faults.take(j)), faults.take(j)) for j in range(len(faults))]
    np.testing.assert_allclose(np.mean(measured, axis=0), i_s, atol=1e-10)


@pytest.mark.parametrize(("bias", "positive"), [(0.0, 0.5), (0.2, 0.7), (0.5, 1.0)])
def test_fault_sizes_lie_in_their_range_and_signs_follow_the_bias(bias: float, positive: float) -> None:
    faults = draw(vehicles=4000, sparsity=40.0, sign_bias=bias)
    values = free_parameters(faults)
    values = values[values != 0.0]
    assert np.mean(values > 0.0) == pytest.approx(positive, abs=0.02)
    sizes = np.abs(values)
    assert (sizes.min(), sizes.mean(), sizes.max()) == pytest.approx((0.05, 0.15, 0.25), abs=0.002)


@pytest.mark.parametrize(("changes", "message"), [
    ({"sign_bias": 0.6}, "expected 0 to 0.5"),
    ({"sign_bias": float("nan")}, "expected 0 to 0.5"),
    ({"sign_bias": 0.2, "symmetric": True}, "and 0 for a symmetric fleet"),
    ({"vehicles": 6, "symmetric": True}, "needs a multiple of 4 vehicles, not 6"),
])  # fmt: skip
def test_impossible_sign_bias_or_size_of_a_symmetric_fleet_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FleetError, match=message):
        draw(**{"vehicles": 4} | changes)


def test_random_streams_are_reproducible_and_differ_by_purpose_seed_and_further_numbers() -> None:
    numbers = [(), (0,), (7,), (7, 0), (7, 0, 0), (0, 7)]
    first, again = ([random_stream(p, *n).random() for p, n in product(Purpose, numbers)] for _ in range(2))
    assert first == again
    assert len(set(first)) == len(first)
