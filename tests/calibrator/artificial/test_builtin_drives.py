import sys

import numpy as np
import pytest

from calibrator.artificial.builtin_drives import _fastsim, builtin_trip
from calibrator.artificial.trips import GroundTruth
from calibrator.errors import FleetError
from ecu_node.database import VehicleDatabase

NOT_MODELLED = {"contactor_state", "junction_box_temperature"}
"""Inputs that the built-in vehicle does not have; its logs hold "not available" for them."""


@pytest.fixture(scope="module")
def trip() -> GroundTruth:
    return builtin_trip(np.random.default_rng(7), duration_s=300.0, name="trip")


def test_currents_obey_the_junction_law(trip: GroundTruth) -> None:
    np.testing.assert_allclose(trip.matrix_a().sum(axis=1), 0.0, atol=1e-9)


def test_trip_has_the_branches_and_inputs_of_the_layout(trip: GroundTruth, database: VehicleDatabase) -> None:
    assert set(trip.currents_a) == set(database.layout.branch_names)
    assert set(trip.inputs) == {item.name for item in database.layout.input} - NOT_MODELLED


def test_seed_decides_the_trip() -> None:
    same = [builtin_trip(np.random.default_rng(s), duration_s=60.0, name="t") for s in (1, 1, 2)]
    np.testing.assert_array_equal(same[0].currents_a["battery"], same[1].currents_a["battery"])
    assert len(same[0]) != len(same[2]) or not np.array_equal(same[0].inputs["speed"], same[2].inputs["speed"])


def test_without_fastsim_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fastsim", None)  # makes its import fail
    with pytest.raises(FleetError, match=r"need fastsim; .*: pip install 'hv-current-correction\[demo\]'$"):
        _fastsim()
