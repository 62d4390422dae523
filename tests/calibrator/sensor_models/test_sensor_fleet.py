"""The second pass over a drive store: who counts as linear, who teaches whom, and who must not stop the fleet."""

from pathlib import Path

import numpy as np
import pytest

from calibrator.drive import Array, Channel, Drive
from calibrator.drives.store import write_drive
from calibrator.sensor_models.choice import LINEAR
from calibrator.sensor_models.families import GainBySign
from calibrator.sensor_models.fleet import SensorFindings, find_sensor_models, findings_of, summaries_about_zeros
from calibrator.sources.fleet_source import Equipment, FleetSource, find_fleet, probe_equipment
from calibrator.sources.vehicles import read_vehicles
from calibrator.summaries.vehicle_summary import VehicleSummary, read_vehicle_summary
from ecu_node.database import VehicleDatabase
from tests.calibrator.sensor_models.sensor_fleets import PERIOD_S, TEMPERATURE, SensorFleet, make_fleet
from tests.calibrator.summaries.small_stores import record_of

VEHICLES, BENT = 12, 3
VOLTAGE, SPEED = 400.0, 100.0
Pass = tuple[list[VehicleSummary], Array, FleetSource, Equipment]


@pytest.fixture(scope="module")
def fleet() -> SensorFleet:
    sensor = GainBySign(drift_positive=0.05, drift_negative=-0.1)
    return make_fleet(vehicles=VEHICLES, put={(BENT, 0): sensor}, seed=1)


@pytest.fixture
def first_pass(fleet: SensorFleet, database: VehicleDatabase, tmp_path: Path) -> Pass:
    """A store of the fleet, read once, with the true offsets as zeros."""
    for j in range(VEHICLES):
        write_drive(tmp_path, as_drive(fleet, j), database.layout)
    source = find_fleet(tmp_path)
    equipment = probe_equipment(source, database, None)
    vehicles, _ = read_vehicles(read_vehicle_summary, source, equipment, database, workers=1)
    return vehicles, fleet.faults.offset_a, source, equipment


def as_drive(fleet: SensorFleet, j: int) -> Drive:
    """Drive whose torque at constant speed and voltage gives the inputs of the fleet's samples."""
    samples = fleet.samples[j]
    driving, recuperation, _, temperature = samples.inputs.T
    inputs = {
        "voltage": np.full(len(driving), VOLTAGE),
        "speed": np.full(len(driving), SPEED),
        "torque": (driving + recuperation) * VOLTAGE / SPEED,
        "junction_box_temperature": temperature,
    }
    time_s = PERIOD_S * np.arange(float(len(driving)))

    def channel(value: Array) -> Channel:
        return Channel(time_s=time_s, value=value, good=np.ones(len(value), bool))

    return Drive(
        vehicle=f"V{j:02d}",
        name="d",
        branches={name: channel(samples.currents_a[:, k]) for k, name in enumerate(("battery", "motor"))},
        inputs={name: channel(value) for name, value in inputs.items()},
    )


def second_pass(
    first: Pass, database: VehicleDatabase, *, held_out: int | None = None, trusted: int | None = None
) -> SensorFindings:
    numbers = np.arange(VEHICLES)
    return find_sensor_models(*first, database, learning=numbers != held_out, trusted=numbers == trusted, workers=1)


def found(findings: SensorFindings) -> set[tuple[int, int]]:
    return {(j, k) for j, row in enumerate(findings.choices) for k, c in enumerate(row) if c.model != LINEAR}


def test_it_is_found_and_only_its_summary_is_replaced(first_pass: Pass, database: VehicleDatabase) -> None:
    findings = second_pass(first_pass, database)
    assert found(findings) == {(BENT, 0)}
    kept = [findings.summaries[j] is vehicle.summary for j, vehicle in enumerate(first_pass[0])]
    assert [j for j, same in enumerate(kept) if not same] == [BENT]
    assert findings.notices == ()


def test_a_vehicle_that_is_held_out_is_judged_and_does_not_change_the_others(
    first_pass: Pass, database: VehicleDatabase
) -> None:
    findings = second_pass(first_pass, database, held_out=BENT)
    assert found(findings) == {(BENT, 0)}
    first_pass[2].vehicles[f"V{BENT:02d}"][0].path.unlink()
    without = second_pass(first_pass, database, held_out=BENT)
    others = [j for j in range(VEHICLES) if j != BENT]
    assert [findings.choices[j] for j in others] == [without.choices[j] for j in others]


def test_the_sensors_of_a_trusted_vehicle_are_linear(first_pass: Pass, database: VehicleDatabase) -> None:
    assert found(second_pass(first_pass, database, trusted=BENT)) == set()


def test_a_vehicle_that_cannot_be_read_again_counts_as_linear_and_is_named(
    first_pass: Pass, database: VehicleDatabase
) -> None:
    first_pass[2].vehicles["V07"][0].path.write_bytes(b"not a drive")
    findings = second_pass(first_pass, database)
    assert found(findings) == {(BENT, 0)}
    assert findings.summaries[7] is first_pass[0][7].summary
    assert [notice for notice in findings.notices if "V07" in notice and "counts as linear" in notice]


def test_too_few_vehicles_all_count_as_linear_and_it_is_said(first_pass: Pass, database: VehicleDatabase) -> None:
    vehicles, zero_a, source, equipment = first_pass
    findings = find_sensor_models(
        vehicles[:6],
        zero_a[:6],
        source,
        equipment,
        database,
        learning=np.ones(6, bool),
        trusted=np.zeros(6, bool),
        workers=1,
    )
    assert found(findings) == set()
    assert "6 vehicles to learn from, at least 8 are needed" in findings.notices[0]


def test_offsets_that_a_nonlinearity_feigned_are_told_by_the_zeros_about_which_it_is_plainer() -> None:
    sensor = GainBySign(drift_positive=0.05, drift_negative=-0.1)
    fleet = make_fleet(vehicles=VEHICLES, put={(BENT, 0): sensor}, sparsity=100.0, seed=1)
    feigned_a = np.zeros((VEHICLES, 2))
    feigned_a[BENT] = 25.0, -25.0
    summaries = [
        summaries_about_zeros([drive], zero_a, period_s=PERIOD_S, temperature=TEMPERATURE)
        for drive, zero_a in zip(fleet.samples, feigned_a, strict=True)
    ]
    assert [len(each) for each in summaries] == [1 + (j == BENT) for j in range(VEHICLES)]
    vehicles = [record_of(f"V{j:02d}", each[0].summary).found for j, each in enumerate(summaries)]
    assert all(vehicle is not None for vehicle in vehicles)
    findings = findings_of(
        [vehicle for vehicle in vehicles if vehicle is not None],
        {f"V{j:02d}": each for j, each in enumerate(summaries)},
        learning=np.ones(VEHICLES, bool),
        trusted=np.zeros(VEHICLES, bool),
    )
    assert found(findings) == {(BENT, 0)}
    modelled, choice = findings.modelled[BENT], findings.choices[BENT][0]
    assert modelled is not None
    assert [each.zero_a for each in modelled.sensors] == [0.0]
    assert choice.excess == pytest.approx(1.0 - 0.9 / 1.05, abs=4.0 * choice.excess_sd)
